"""The paper's findings as runs of the benchmark and expected differences between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

from edge.artifacts.files import MANIFEST_NAME, ArtifactError, read_manifest
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError, PolicySpec
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.conditions.variants import artifact_directory

AFTER, BEFORE = "rl", "no-rl"
"""Folders of the shipped model and of the model before reinforcement learning (docs/benchmark.md)."""
WHOLE, SILENT = "full", "no-reasoning"
"""Folders of the reference of the ablations, and of the network trained on prompts without reasoning."""
SWEEP_S: Final = (1, 2, 3, 4, 5)
LONG_S: Final = (3, 4, 5)
SWAP_SEED: Final = 1
NO_REASONING_S: Final = 0.25  # the paper's 4 Hz (section 4.4)
DRIFT_LEAST: Final = -10.0
"""Largest loss of SR that counts as none under typical drift or other wordings, points."""
WORDING_LEAST: Final = -10.0
SWAP_LEAST: Final = 30.0

WORDINGS_ROW: Final = "wordings"
"""Name of the claim that needs a suite with held-out wordings."""

Pair = tuple[str, str]
"""Names of two runs; a difference is the second minus the first."""


@dataclass(frozen=True)
class Run:
    """Run of the benchmark; `latency_s` None: the command line's latency."""

    variant: str | None
    """Folder of the model; None: the privileged expert."""
    mode: str = "async"
    latency_s: float | None = None
    drift: str = "none"
    wordings: str = "benchmark"
    swap: int | None = None

    def conditions(self, root: Path, base: LatencyProfile) -> Conditions:
        """Return the conditions for edge-bench. Raises ConditionsError if `root` lacks the model."""
        if self.variant is None:
            return Conditions(PolicySpec("expert"))
        latency = base if self.latency_s is None else at_mean(base, self.latency_s)
        if self.mode == "no-reasoning":
            latency = LatencyProfile.constant(NO_REASONING_S)
        where, variant = located(root, self.variant)
        return Conditions(
            PolicySpec("artifacts", str(where.absolute())),
            mode=self.mode,
            latency=latency,
            drift=self.drift,
            variant=variant,
            wordings=self.wordings,
            swap_instructions=self.swap,
        )


@dataclass(frozen=True)
class Finding:
    """Claim: a metric's mean difference over `pairs` (minus that over `minus`), by episode, is above `least`."""

    row: str
    claim: str
    source: str
    pairs: tuple[Pair, ...]
    metric: str = "sr"
    least: float = 0.0
    minus: tuple[Pair, ...] = ()
    instead_of: tuple[str, ...] = ()
    """Folders of models: the claim is tested only if one is missing, in place of a claim about them."""

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the claim's runs."""
        return tuple(dict.fromkeys(name for pair in (*self.pairs, *self.minus) for name in pair))


@dataclass(frozen=True)
class Level:
    """Claim about one run: a metric's mean is at least (`sign` 1) or at most (-1) `bound`."""

    row: str
    claim: str
    source: str
    run: str
    metric: str
    bound: float
    sign: int = 1

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the claim's runs."""
        return (self.run,)


RUNS: Final = MappingProxyType(
    {
        "rl": Run(AFTER),
        "rl-sync": Run(AFTER, mode="sync"),
        "rl-no-reasoning": Run(AFTER, mode="no-reasoning"),
        "rl-typical-drift": Run(AFTER, drift="typical"),
        "rl-severe-drift": Run(AFTER, drift="severe"),
        "rl-swapped": Run(AFTER, swap=SWAP_SEED),
        "rl-training-words": Run(AFTER, wordings="training"),
        "full": Run(WHOLE),
        "no-reasoning": Run(SILENT, mode="no-reasoning"),
        "no-latency": Run("no-latency"),
        "no-motion-offset": Run("no-motion-offset"),
        "waypoints": Run("waypoints"),
        "expert": Run(None),
        **{f"rl-{s}s": Run(AFTER, latency_s=float(s)) for s in SWEEP_S},
        **{f"no-rl-{s}s": Run(BEFORE, latency_s=float(s)) for s in SWEEP_S},
    }
)

_SWEEP: Final = {s: (f"no-rl-{s}s", f"rl-{s}s") for s in SWEEP_S}
_SHORT_S: Final = tuple(s for s in SWEEP_S if s not in LONG_S)

CLAIMS: Final[Sequence[Finding | Level]] = (
    Level("score", "SR of the shipped model is at least 55 %", "Table 1", "rl", "sr", 55.0),
    Level("score", "CR of the shipped model is at most 28 %", "Table 1", "rl", "cr", 28.0, -1),
    Level("score", "SPL of the shipped model is at least 50 %", "Table 1", "rl", "spl", 50.0),
    Finding("async", "asynchronous inference beats synchronous", "Table 1", (("rl-sync", "rl"),)),
    Finding("latency", "trained with latency beats trained without", "Table 2", (("no-latency", "full"),)),
    Finding("interface", "keys and values guide better than waypoints", "Table 2", (("waypoints", "full"),)),
    Finding("offset", "with motion offset beats without", "Table 6", (("no-motion-offset", "full"),)),
    Finding("rl", "after PPO beats before, over 3 to 5 s", "Figure 5", tuple(_SWEEP[s] for s in LONG_S)),
    *(Finding("rl", f"after PPO beats before, at {s} s", "Figure 5", (_SWEEP[s],)) for s in SWEEP_S),
    Finding(
        "rl",
        "PPO gains more at 3 to 5 s than at 1 to 2 s",
        "Figure 5",
        tuple(_SWEEP[s] for s in LONG_S),
        minus=tuple(_SWEEP[s] for s in _SHORT_S),
    ),
    Finding("reasoning", "trained with reasoning beats trained without", "Table 4", (("no-reasoning", "full"),)),
    Finding(
        "reasoning", "the shipped model with reasoning beats itself without", "Table 4", (("rl-no-reasoning", "rl"),),
        instead_of=(WHOLE, SILENT),
    ),
    Finding(
        "drift", "typical drift costs less than 10 points of SR", "Table 14", (("rl", "rl-typical-drift"),),
        least=DRIFT_LEAST,
    ),
    Finding(
        "words", "with swapped instructions SR falls by 30 points or more", "own", (("rl-swapped", "rl"),),
        least=SWAP_LEAST,
    ),
    Finding(
        WORDINGS_ROW, "held-out wordings cost less than 10 points of SR against training's", "own",
        (("rl-training-words", "rl"),), least=WORDING_LEAST,
    ),
)  # fmt: skip
EXTRA: Final = MappingProxyType({"drift": ("rl-severe-drift",), "ceiling": ("expert",)})
"""Runs that are reported with a row without a claim."""
ROWS: Final = tuple(dict.fromkeys([*(claim.row for claim in CLAIMS), *EXTRA]))


def runs_of(rows: Sequence[str], claims: Sequence[Finding | Level] = CLAIMS) -> list[str]:
    """Return the names of all runs of some rows, in the rows' order."""
    names: list[str] = []
    for row in rows:
        names += [name for claim in claims if claim.row == row for name in claim.runs]
        names += EXTRA.get(row, ())
    return list(dict.fromkeys(names))


def claims_of(root: Path) -> tuple[list[Finding | Level], dict[str, str]]:
    """Return the testable claims about the models in `root`, and reasons by row for the others."""
    claims: list[Finding | Level] = []
    left_out: dict[str, str] = {}
    for claim in CLAIMS:
        if isinstance(claim, Finding):
            if claim.instead_of and all((root / name / MANIFEST_NAME).is_file() for name in claim.instead_of):
                continue
            alike = next((pair for pair in (*claim.pairs, *claim.minus) if _same_run(root, pair)), None)
            if alike is not None:
                one, other = (RUNS[name].variant for name in alike)
                left_out[f"row {claim.row}"] = f"{one} and {other} have the same weights: there is nothing to compare"
                continue
        claims.append(claim)
    return claims, left_out


def _same_run(root: Path, pair: Pair) -> bool:
    """Return whether two runs differ only in the name of their model."""
    one, other = (RUNS[name] for name in pair)
    if None in (one.variant, other.variant) or replace(one, variant=other.variant) != other:
        return False
    graphs = [_graphs(root / str(run.variant)) for run in (one, other)]
    return bool(graphs[0]) and graphs[0] == graphs[1]


def _graphs(directory: Path) -> dict[str, str]:
    """Return file → hash of a model's graphs; empty if the manifest has none. Equal weights give equal bytes."""
    try:
        files = read_manifest(directory).get("files", {})
        return {name: str(file["sha256"]) for name, file in files.items() if not name.startswith("report.")}
    except (ArtifactError, OSError, AttributeError, KeyError, TypeError):
        return {}


def at_mean(base: LatencyProfile, mean_s: float) -> LatencyProfile:
    """Return a profile with that mean: constant if the base is, else of the base's shape."""
    return LatencyProfile.constant(mean_s) if len(base.generation_s) == 1 else base.scaled_to_mean(mean_s)


def located(root: Path, variant: str) -> tuple[Path, str | None]:
    """Return a model's (policy directory, --variant); a root that is one artifact directory is the shipped model.

    Raises ConditionsError.
    """
    if variant == AFTER and not (root / variant).is_dir() and (root / MANIFEST_NAME).is_file():
        return root, None
    if (root / variant / MANIFEST_NAME).is_file():
        artifact_directory(root, variant)
        return root, variant
    raise ConditionsError(f"{root / variant}: no artifacts; export that model there (edge-export --out)")
