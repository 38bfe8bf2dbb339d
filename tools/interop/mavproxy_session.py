"""A session of MAVProxy with `edge-hil --protocol mavlink`: its command line is written to, its output read.

  python mavproxy_session.py MAVPROXY.PY PORT    MAVProxy listens on UDP PORT of the loopback, where the rover calls

Prints one JSON object: what was typed, the answer that was waited for, and how long that took.
"""

from __future__ import annotations

import json
import queue
import re
import subprocess
import sys
import tempfile
import threading
import time

ANSWER_S = 25.0
COLOURS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class MavProxy:
    """One MAVProxy process."""

    def __init__(self, program: str, port: int, folder: str) -> None:
        # In its own folder: it writes its logs where it is started.
        command = [program, f"--master=udpin:127.0.0.1:{port}", "--nowait", "--source-system=255", "--retries=0"]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=folder,
            bufsize=1,
        )
        self._pieces: queue.Queue[str] = queue.Queue()
        self.output = ""
        self.steps: list[dict[str, object]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._pieces.put(COLOURS.sub("", line))

    def type(self, line: str, answer: str = "", seconds: float = ANSWER_S) -> str:
        """Type a line (none if ""), wait for an answer that matches a regular expression; returns it."""
        begin, seen = time.monotonic(), ""
        if line:
            assert self._process.stdin is not None
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        found = None
        while answer and found is None and time.monotonic() - begin < seconds:
            try:
                seen += self._pieces.get(timeout=0.1)
            except queue.Empty:
                continue
            found = re.search(answer, seen)
        self.output += seen
        if answer and found is None:
            raise RuntimeError(f"{line!r}: expected {answer!r} within {seconds:g} s, found {self.output[-2000:]!r}")
        matched = "" if found is None else found[0].strip()
        self.steps.append({"typed": line, "answer": matched, "after_s": round(time.monotonic() - begin, 2)})
        return matched

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def session(proxy: MavProxy) -> dict[str, object]:
    """Connect, read and set parameters, arm, drive with the sticks, disarm."""
    proxy.type("", r"(?i)detected vehicle 1:1.*|online system 1.*")
    proxy.type("", r"Received \d+ parameters.*")
    proxy.type("param show COM_OF_LOSS_T", r"COM_OF_LOSS_T +0?\.5\d*")
    proxy.type("param set COM_OF_LOSS_T 0.8")
    time.sleep(1.0)
    proxy.type("param show COM_OF_LOSS_T", r"COM_OF_LOSS_T +0?\.8\d*")
    proxy.type("param show MAV_SYS_ID", r"MAV_SYS_ID +1(?!\d)")
    # By its numbers: MAVProxy 1.8.75's own "mode NAME" fails on PX4's modes ("required argument is not a float").
    proxy.type("long DO_SET_MODE 1 6 0", r"DO_SET_MODE: \w+")
    proxy.type("arm throttle", r"COMPONENT_ARM_DISARM: \w+")
    proxy.type("long DO_SET_MODE 1 1 0", r"DO_SET_MODE: \w+")
    proxy.type("rc 3 1900")
    time.sleep(4.0)
    proxy.type("rc 3 1500")
    time.sleep(1.5)
    proxy.type("rc 1 1900")
    time.sleep(2.0)
    proxy.type("rc 1 1500")
    time.sleep(1.0)
    proxy.type("status", r"LOCAL_POSITION_NED[^\n]*")
    proxy.type("disarm", r"COMPONENT_ARM_DISARM: \w+")
    return {"steps": proxy.steps}


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        proxy = MavProxy(sys.argv[1], int(sys.argv[2]), folder)
        try:
            result = session(proxy)
        finally:
            proxy.close()
            sys.stderr.write(proxy.output)
    sys.stdout.write(json.dumps(result) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
