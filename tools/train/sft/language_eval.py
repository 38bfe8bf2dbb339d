"""Evaluation of the language model on held-out layouts: decoded text against the true text.

The prompt contains either the true previous progress, as in training, or the progress that the model decoded itself in
the previous generation along a drive, as on the robot.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from math import hypot
from typing import Any, Final

import numpy as np

from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.state.reasoning_text import AHEAD, WAYPOINT_TIMES_S, ReasoningText, Turn, parse_text
from export.model.language import LanguageModel
from tools.train.config.collect import RATE_HZ
from tools.train.config.sft import EvalConfig
from tools.train.samples.anchors import WAYPOINTS_START, Anchor, Drawn, Prompts, turns_back
from tools.train.samples.language_batch import FrameTokens, Row, collate, decode, frames_of

_TAG: Final = 0xE7A1


class Score:
    """Accumulates scores of answers; `numbers` are their shares and means.

    A change is an anchor whose progress differs from that of the previous generation. A false change is an answer with
    new progress at an anchor without a change.
    """

    def __init__(self, gap_s: float) -> None:
        """`gap_s`: time since the previous generation's newest frame."""
        self._gap_s = gap_s
        self._count: Counter[str] = Counter()
        self._errors_m: list[list[float]] = []

    def add(self, text: str, anchor: Anchor) -> None:
        """Add one answer to an anchor."""
        found = self._count
        found["answers"] += 1
        answer = parse_text(text)
        waypoints, progress = answer.waypoints, answer.progress
        found["waypoints"] += waypoints is not None
        found["progress"] += progress is not None
        found["progress right"] += progress == anchor.progress
        if anchor.before(self._gap_s) not in (None, anchor.progress):
            found["changes"] += 1
            found["change right"] += progress == anchor.progress
        elif anchor.before(self._gap_s) is not None:
            found["repeats"] += 1
            found["false change"] += progress != anchor.progress
        said_back, true_back = (turns_back(text) for text in (answer, anchor.reasoning))
        found["backs"] += true_back
        found["backs said"] += said_back
        found["backs right"] += said_back and true_back
        true_side = side_of(anchor.reasoning)
        if true_side is not None:
            found["sides"] += 1
            found["side right"] += side_of(answer) == true_side
        found_names, true_names = landmarks_of(answer), landmarks_of(anchor.reasoning)
        found["landmarks said"] += found_names.total()
        found["landmarks there"] += true_names.total()
        found["landmarks right"] += (found_names & true_names).total()
        if waypoints is not None:
            pairs = zip(waypoints, anchor.points, strict=True)
            self._errors_m.append([hypot(a[0] - b[0], a[1] - b[1]) for a, b in pairs])

    def numbers(self) -> dict[str, Any]:
        """Return the scores as JSON values; a share without cases is None."""
        n = self._count
        errors = np.array(self._errors_m).reshape(-1, len(WAYPOINT_TIMES_S))
        return {
            "answers": n["answers"],
            "waypoints_parsable": _share(n["waypoints"], n["answers"]),
            "progress_parsable": _share(n["progress"], n["answers"]),
            "progress_right": _share(n["progress right"], n["answers"]),
            "change_right": _share(n["change right"], n["changes"]),
            "changes": n["changes"],
            "false_change": _share(n["false change"], n["repeats"]),
            "side_right": _share(n["side right"], n["sides"]),
            "sides": n["sides"],
            "back_recall": _share(n["backs right"], n["backs"]),
            "back_precision": _share(n["backs right"], n["backs said"]),
            "backs": n["backs"],
            "landmark_precision": _share(n["landmarks right"], n["landmarks said"]),
            "landmark_recall": _share(n["landmarks right"], n["landmarks there"]),
            "waypoint_error_m": [float(mean) for mean in errors.mean(0)] if len(errors) else None,
        }

    def points(self) -> dict[str, object]:
        """Return the scores that apply to answers without reasoning text."""
        numbers = self.numbers()
        return {key: numbers[key] for key in ("answers", "waypoints_parsable", "waypoint_error_m")}


def evaluate(decoder: GreedyDecoder, anchors: Sequence[Anchor], config: EvalConfig, *, seed: int) -> dict[str, Any]:
    """Return scores as `taught` (true previous progress), `own` (its own previous progress) and `waypoints_only`."""
    rng = np.random.default_rng((seed, _TAG))
    some = _some(anchors, config.anchors, rng)
    scores: dict[str, Any] = {
        "taught": taught(decoder, some, config.gap_s).numbers(),
        "waypoints_only": taught(decoder, some, config.gap_s, waypoints_only=True).points(),
    }
    ids = sorted({anchor.drive_id for anchor in anchors})
    chosen = {ids[int(i)] for i in rng.permutation(len(ids))[: config.drives]}
    scores["own"] = closed_loop(decoder, [each for each in anchors if each.drive_id in chosen], config.gap_s, rng)
    return scores


def evaluate_epoch(
    decoder: GreedyDecoder, anchors: Sequence[Anchor], config: EvalConfig, *, seed: int
) -> dict[str, float]:
    """Return a few scores of `epoch_anchors` fixed anchors for a curve; empty if there are none."""
    some = _some(anchors, config.epoch_anchors, np.random.default_rng((seed, _TAG)))
    numbers = taught(decoder, some, config.gap_s).numbers()
    found = {
        "parsable_share": numbers["waypoints_parsable"],
        "progress_share": numbers["progress_right"],
        "side_share": numbers["side_right"],
        "landmark_recall": numbers["landmark_recall"],
        "waypoint_error_3s_m": numbers["waypoint_error_m"] and numbers["waypoint_error_m"][0],
    }
    return {key: value for key, value in found.items() if value is not None}


def taught(
    decoder: GreedyDecoder, questions: Sequence[tuple[Anchor, str]], gap_s: float, *, waypoints_only: bool = False
) -> Score:
    """Score answers to (anchor, wording) with the true progress of `gap_s` ago in the prompt."""
    drawn = [(anchor, Drawn(wording, anchor.before(gap_s), waypoints_only)) for anchor, wording in questions]
    score = Score(gap_s)
    for (anchor, _), text in zip(drawn, decoder.generate(drawn), strict=True):
        score.add(text, anchor)
    return score


def _some(anchors: Sequence[Anchor], count: int, rng: np.random.Generator) -> list[tuple[Anchor, str]]:
    """Draw `count` anchors, each with one of its wordings."""
    chosen = [anchors[int(i)] for i in sorted(rng.permutation(len(anchors))[:count])]
    return [(anchor, anchor.wordings[int(rng.integers(len(anchor.wordings)))]) for anchor in chosen]


class GreedyDecoder:
    """Greedy decoding of a language model, in batches of similar length."""

    def __init__(self, language: LanguageModel, prompts: Prompts, tokens: FrameTokens, config: EvalConfig) -> None:
        self._language, self._prompts, self._tokens, self._config = language, prompts, tokens, config

    def constraint(self, context: DecodingContext) -> TextConstraint:
        """Return what the runner constrains an answer with."""
        return self._prompts.constraint(context)

    def generate(
        self, questions: Sequence[tuple[Anchor, Drawn]], constraints: Sequence[TextConstraint | None] | None = None
    ) -> list[str]:
        """Return the text after each prompt, with the start that it was given; `constraints`: one a question."""
        constraints = constraints or [None] * len(questions)
        rows = [
            Row(self._prompts.prompt(anchor, drawn), (), frames_of(self._tokens, anchor.drive_id, anchor.frames))
            for anchor, drawn in questions
        ]
        order = sorted(range(len(rows)), key=lambda i: len(rows[i].prompt))
        texts = [""] * len(rows)
        language = self._language
        for start in range(0, len(order), self._config.batch):
            chosen = order[start : start + self._config.batch]
            batch = collate(
                [rows[i] for i in chosen],
                img_context_id=language.config.img_context_id,
                device=language.embed.weight.device,
            )
            answers = decode(language, batch, self._config.max_new_tokens, [constraints[i] for i in chosen])
            for i, decoded in zip(chosen, answers, strict=True):
                texts[i] = (WAYPOINTS_START if questions[i][1].waypoints_only else "") + self._prompts.text(decoded.ids)
        return texts


def closed_loop(
    decoder: GreedyDecoder, anchors: Iterable[Anchor], gap_s: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Score along drives where `before` is the model's own last progress, as on the robot.

    The runner's rule for progress applies; its rules for the next turn, which need odometry, do not.
    """
    drives: dict[str, list[Anchor]] = {}
    for anchor in anchors:
        if anchor.k % round(gap_s * RATE_HZ) == 0:
            drives.setdefault(anchor.drive_id, []).append(anchor)
    wording = {drive: each[0].wordings[int(rng.integers(len(each[0].wordings)))] for drive, each in drives.items()}
    context = dict.fromkeys(drives, DecodingContext())
    score = Score(gap_s)
    for step in range(max((len(each) for each in drives.values()), default=0)):
        now = [each[step] for each in drives.values() if step < len(each)]
        drawn = [(anchor, Drawn(wording[anchor.drive_id], context[anchor.drive_id].before)) for anchor in now]
        constraints = [decoder.constraint(context[anchor.drive_id]) for anchor in now]
        for anchor, constraint, text in zip(now, constraints, decoder.generate(drawn, constraints), strict=True):
            score.add(text, anchor)
            context[anchor.drive_id] = context[anchor.drive_id].after(text, constraint)
    return score.numbers()


def side_of(text: ReasoningText) -> str | None:
    """Return the side of the planned turn, "left" or "right"; None for another plan."""
    action = None if text.plan is None else text.plan.action
    return action.side if isinstance(action, Turn) and action.side != AHEAD else None


def landmarks_of(text: ReasoningText) -> Counter[str]:
    """Count the names of the objects in view."""
    return Counter(seen.name for seen in text.objects or ())


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
