"""Stamps the commit and the pinned packages into a wheel; everything else is in pyproject.toml."""

import shutil
import subprocess
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class StampWheel(build_py):
    """Writes commit.txt and constraints-hashed.txt into what is built, never into the checkout."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        pins = "constraints-hashed.txt"
        shutil.copy(Path(__file__).with_name(pins), Path(self.build_lib) / "edge/deploy" / pins)
        git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
        done = subprocess.run(git, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            (Path(self.build_lib) / "firmware_bridge/commit.txt").write_text(done.stdout)


setup(cmdclass={"build_py": StampWheel})
