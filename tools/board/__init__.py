"""An emulated arm64 computer with Debian 12, to prove that a robot's computer can install and run this package.

Run `python -m tools.board --help` as root; CONTRIBUTING.md says what it needs.
"""
