"""Stamps the commit into a wheel; everything else is in pyproject.toml."""

import subprocess
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class StampCommit(build_py):
    """Writes firmware_bridge/commit.txt into what is built, never into the checkout."""

    def run(self) -> None:
        super().run()
        git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
        done = subprocess.run(git, capture_output=True, text=True, check=False)
        if done.returncode == 0 and not self.editable_mode:
            (Path(self.build_lib) / "firmware_bridge/commit.txt").write_text(done.stdout)


setup(cmdclass={"build_py": StampCommit})
