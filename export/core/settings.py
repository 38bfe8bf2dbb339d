"""`--set KEY=VALUE` sorted by what it changes: the network (`model.…`) or the target."""

from __future__ import annotations

from collections.abc import Sequence

MODEL_PREFIX = "model."


def model_settings(settings: Sequence[str]) -> dict[str, str]:
    """Numbers of the network by `section.field`."""
    pairs = [setting.partition("=") for setting in settings]
    return {
        key.strip().removeprefix(MODEL_PREFIX): value for key, _, value in pairs if key.strip().startswith(MODEL_PREFIX)
    }


def target_settings(settings: Sequence[str]) -> list[str]:
    """Those that change the target; a graph's precision also ends the search for a better one."""
    found: list[str] = []
    for setting in settings:
        key = setting.partition("=")[0].strip()
        if key.startswith(MODEL_PREFIX):
            continue
        found.append(setting)
        section, _, field = key.rpartition(".")
        if section.startswith("graphs.") and field == "precision":
            found.append(f"{section}.candidates=")
    return found
