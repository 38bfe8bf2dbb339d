"""Speculative decoding against one new token a call: equal bits, acceptance, tokens per call, duration.

    python -m tools.bench.speculation --artifacts out/nano --episodes 'office-*-0-*' --json out/bench/speculation.json
    python -m tools.bench.speculation --artifacts out/nano --prompts out/bench/prompts
    python -m tools.bench.speculation --artifacts out/1b --texts out/bench/speculation.json --rounds 7

The first form drives benchmark episodes in virtual time. Each generation is decoded three times, in turn: with one row
a call (`single`), with one new token a call and the row of padding that makes speculation exact (`plain`), and with
guesses (`guessing`). `--save DIR` keeps its prompts, which the second form decodes again. The third form decodes the
first one's texts with other graphs, such as the paper's size with random weights: each choice is replaced by the text's
token, so the calls are those of a trained model. Exit code 1 when `plain` and `guessing` differ in a token, a key or a
value, 2 for bad input.

CPU times are of the calling thread, which computes everything: they also compare on a busy machine.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.geometry import SE2
from edge.inference.calls import Floats
from edge.inference.language import Generation, LanguageModel
from edge.inference.latency_profile import LatencyProfile
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.prompt import EXAMPLE_BEFORE, EXAMPLE_PAST_PATH, Segment
from edge.state.ring import EncodedFrame
from edge.state.switches import Decoding, SwitchOptions
from sim_hil.benchmark.arguments import choose
from sim_hil.benchmark.env.world import EpisodeWorld, WorldOptions
from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.suite.episode import Episode, SuiteError, load_suite
from tools.bench import bad_input, command_parser
from tools.bench.peers.forced_text import ForcedText, context_of

VARIANTS = ("single", "plain", "guessing")
INSTRUCTION = "walk down the corridor, pass the vending machine and stop at the second door on the left"


@dataclass(frozen=True)
class Sample:
    """One generation of one variant."""

    variant: str
    text: int
    """Number of the generation, or of the forced text."""
    wall_ms: float
    cpu_ms: float
    decode_ms: float
    prompt_tokens: int
    new_tokens: int
    calls: int
    guessed: int
    accepted: int


class Variants:
    """The same graphs in all variants, and what their generations have in common."""

    def __init__(self, artifacts: Artifacts) -> None:
        """Raises ArtifactError where the device does not give equal bits, so that nothing is guessed."""
        self.models = {name: LanguageModel(artifacts, threads=1) for name in VARIANTS}
        self.models["single"].rows = (1,)
        if (line := self.models["guessing"].speculate()) is not None:
            raise ArtifactError(line)
        self.samples: list[Sample] = []
        self.texts: list[str] = []
        self.different: list[int] = []
        """Generations of which `plain` and `guessing` differ in a bit."""
        self.single_differs: list[int] = []
        """Generations of which `single` chose another token."""

    def decode(self, work: Callable[[LanguageModel], Generation]) -> Generation:
        """Run a generation in every variant, each first in turn; return that of `plain`."""
        number, found = len(self.texts), dict[str, Generation]()
        for name in (*VARIANTS[number % 3 :], *VARIANTS[: number % 3]):
            wall_ns, cpu_ns = time.monotonic_ns(), time.thread_time_ns()
            made = found[name] = work(self.models[name])
            took_ms = ((time.monotonic_ns() - wall_ns) / 1e6, (time.thread_time_ns() - cpu_ns) / 1e6)
            counts = (made.prompt_tokens, made.new_tokens, len(made.call_tokens), made.guessed, made.accepted)
            self.samples.append(Sample(name, number, *took_ms, made.decode_ms, *counts))
        plain, guessing = found["plain"], found["guessing"]
        equal = np.array_equal(plain.last_layer_kv, guessing.last_layer_kv)
        if plain.token_ids != guessing.token_ids or not equal:
            self.different.append(number)
        if plain.token_ids != found["single"].token_ids:
            self.single_differs.append(number)
        self.texts.append(plain.text)
        return plain

    def result(self) -> dict[str, Any]:
        """Return figures and samples."""
        figures: dict[str, Any] = {}
        for name in VARIANTS:
            mine = [sample for sample in self.samples if sample.variant == name]
            tokens, calls = sum(s.new_tokens for s in mine), sum(s.calls for s in mine)
            figures[name] = {
                **{f"{key}_p50": statistics.median(getattr(s, key) for s in mine) for key in ("wall_ms", "cpu_ms")},
                "decode_ms_p50": statistics.median(s.decode_ms for s in mine),
                "tokens_per_generation": tokens / len(mine),
                "tokens_per_call": tokens / calls,
            }
        guesses = [sample for sample in self.samples if sample.variant == "guessing"]
        return {
            "generations": len(self.texts),
            "different": self.different,
            "single_row_differs": self.single_differs,
            "acceptance": sum(s.accepted for s in guesses) / max(1, sum(s.guessed for s in guesses)),
            "cpu_single_over_guessing": self._ratio("single"),
            "cpu_plain_over_guessing": self._ratio("plain"),
            "variants": figures,
            "texts": self.texts,
            "samples": [asdict(sample) for sample in self.samples],
            "tagged": "measured",
        }

    def _ratio(self, other: str) -> float:
        """Return the median over generations of another variant's CPU time over that with guesses."""
        cpu_ms = {(sample.variant, sample.text): sample.cpu_ms for sample in self.samples}
        return statistics.median(cpu_ms[other, n] / cpu_ms["guessing", n] for n in range(len(self.texts)))


class _Recorded:
    """Takes the place of the policy's language model, and decodes each of its generations in every variant."""

    def __init__(self, variants: Variants) -> None:
        self._variants = variants
        plain = variants.models["plain"]
        self.prompt, self.runtime, self.check_instruction = plain.prompt, plain.runtime, plain.check_instruction
        self.prompts = Prompts()
        self._segments: list[Segment] = []
        self._context = DecodingContext()

    def constraint(self, context: DecodingContext) -> TextConstraint:
        self._context = context
        return self._variants.models["plain"].constraint(context)

    def begin(self, cancelled: Callable[[], bool]) -> _Recorded:
        self._segments = []
        return self

    def feed(self, segments: Sequence[Segment]) -> None:
        self._segments += segments

    def finish(self, segments: Sequence[Segment], *, max_new_tokens: int, constraint: TextConstraint) -> Generation:
        plain = self._variants.models["plain"]
        self.prompts.put([*self._segments, *segments], self._context, max_new_tokens)

        def work(model: LanguageModel) -> Generation:
            rules = constraint if model is plain else model.constraint(self._context)
            run = model.begin(lambda: False)
            for segment in self._segments:
                run.feed([segment])
            return run.finish(segments, max_new_tokens=max_new_tokens, constraint=rules)

        return self._variants.decode(work)


class Prompts:
    """Recorded prompts of one episode: a JSON file of texts and rules, and a file of visual tokens."""

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []
        self.frames: list[Floats] = []

    def put(self, segments: Sequence[Segment], context: DecodingContext, max_new_tokens: int) -> None:
        """Take the prompt of a generation."""
        parts = []
        for segment in segments:
            parts.append({"ids": list(segment.ids), "frame": None if segment.tokens is None else len(self.frames)})
            if segment.tokens is not None:
                self.frames.append(segment.tokens.copy())
        before = None if context.before is None else asdict(context.before)
        rules = {**context.record(), "before": before}
        self.records.append({"segments": parts, "rules": rules, "max_new_tokens": max_new_tokens})

    def save(self, path: Path) -> None:
        """Write PATH.json and PATH.npz."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".json").write_text(json.dumps(self.records), encoding="utf-8")
        np.savez(path.with_suffix(".npz"), frames=np.array(self.frames))

    @staticmethod
    def decode(path: Path, variants: Variants) -> None:
        """Decode what `save` wrote in every variant. Raises ArtifactError."""
        try:
            frames = np.load(path.with_suffix(".npz"))["frames"]
            for record in json.loads(path.read_text(encoding="utf-8")):
                segments = [
                    Segment(tuple(part["ids"]), None if part["frame"] is None else frames[part["frame"]])
                    for part in record["segments"]
                ]
                context, most = context_of(record["rules"]), int(record["max_new_tokens"])
                variants.decode(
                    lambda model, segments=segments, context=context, most=most: model.generate(  # type: ignore[misc]
                        segments, max_new_tokens=most, cancelled=lambda: False, constraint=model.constraint(context)
                    )
                )
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise ArtifactError(f"{path}: expected prompts that --save wrote ({error!r})") from error


def drive(variants: Variants, artifacts: Path, episodes: Sequence[Episode], decoding: str, save: Path | None) -> None:
    """Drive the episodes with `plain`, one second of latency a generation; write their prompts below `save`."""
    switches = SwitchOptions(decoding=Decoding(decoding))
    for episode in episodes:
        policy = ArtifactsPolicy(
            artifacts, mode="async", latency=LatencyProfile.constant(1.0), robot=robot_config(), switches=switches
        )
        recorded = _Recorded(variants)
        policy.language = cast("LanguageModel", recorded)
        world = EpisodeWorld(episode, WorldOptions(camera=policy.camera))
        policy.reset(episode, episode.instructions[0], None, episode.seed)
        while not world.done:
            world.step(policy.act(world.observe()))
        world.close()
        if save is not None:
            recorded.prompts.save(save / episode.id)
        sys.stderr.write(f"speculation: {episode.id}: {len(variants.texts)} generations so far\n")


def force(variants: Variants, texts: Sequence[str], rounds: int) -> None:
    """Decode the texts in order, `rounds` times, behind a prompt of usual length with frames of noise."""
    plain = variants.models["plain"]
    shape = plain.no_frame.shape
    rng, here = np.random.default_rng(0), SE2(0.0, 0.0, 0.0)
    count = len(plain.runtime.frame_offsets_s)
    frames = [EncodedFrame(i, here, rng.standard_normal(shape, dtype=np.float32)) for i in range(count)]
    segments = plain.prompt.build(frames, INSTRUCTION, EXAMPLE_PAST_PATH, EXAMPLE_BEFORE)
    end = plain.runtime.im_end_id
    for text in [text for _ in range(rounds) for text in texts]:
        tokens = plain.encode(text)

        def work(model: LanguageModel, tokens: Sequence[int] = tokens) -> Generation:
            rules = ForcedText(tokens, end, plain.encode)
            limit = len(tokens) + 1
            return model.generate(segments, max_new_tokens=limit, cancelled=lambda: False, constraint=rules)

        variants.decode(work)


@command_line("speculation")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--suite", default="dynanav", metavar="NAME|FILE", help="suite of the episodes (default: dynanav)")
    p.add_argument("--episodes", nargs="+", default=["*"], metavar="GLOB", help="episodes to drive (default: all)")
    p.add_argument("--decoding", choices=("free", "constrained"), default="constrained")
    p.add_argument("--save", type=Path, metavar="DIR", help="write the prompts of the episodes there")
    p.add_argument("--prompts", type=Path, metavar="DIR", help="prompts that --save wrote: decode them instead")
    p.add_argument("--texts", type=Path, metavar="FILE", help="a result of this command: decode its texts instead")
    p.add_argument("--first", type=int, default=0, metavar="N", help="skip so many of its texts (default: 0)")
    p.add_argument("--count", type=int, default=8, metavar="N", help="decode so many of its texts (default: 8)")
    p.add_argument("--rounds", type=int, default=1, help="repetitions of those texts (default: 1)")
    args = p.parse_args(argv)
    try:
        check_result_target(args.json)
        if args.rounds < 1 or args.count < 1 or args.first < 0:
            raise ArtifactError("--rounds and --count must be 1 or more, --first 0 or more")
        texts = None if args.texts is None else _texts(args.texts)[args.first : args.first + args.count]
        driven = texts is None and args.prompts is None
        episodes = choose(load_suite(args.suite), args.episodes) if driven else []
        variants = Variants(load_artifacts(args.artifacts))
        for path in [] if args.prompts is None else sorted(args.prompts.glob("*.json")):
            Prompts.decode(path, variants)
    except (ArtifactError, SuiteError, OSError) as error:
        return bad_input("speculation", error)
    if driven:
        drive(variants, args.artifacts, episodes, args.decoding, args.save)
    if texts is not None:
        force(variants, texts, args.rounds)
    if not variants.texts:
        return bad_input("speculation", ValueError("no generation was decoded: expected episodes or texts with some"))
    result = variants.result()
    write_result(args.json, result)
    if args.json != "-":
        _print(result)
    return EXIT_CHECK_FAILED if variants.different else EXIT_DONE


def _texts(path: Path) -> list[str]:
    """Read the texts of a result. Raises ArtifactError."""
    try:
        texts = json.loads(path.read_text(encoding="utf-8"))["texts"]
    except (ValueError, KeyError, TypeError) as error:
        raise ArtifactError(f"{path}: expected a result of this command with texts ({error!r})") from error
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        raise ArtifactError(f"{path}: expected texts to be a list of texts")
    return texts


def _print(result: dict[str, Any]) -> None:
    print(f"{result['generations']} generations, {len(result['different'])} of them differ between plain and guessing")
    print(f"one row a call chooses another token in {len(result['single_row_differs'])} of them")
    print(f"acceptance {result['acceptance']:.3f}")
    for name, figures in result["variants"].items():
        print(f"{name}: " + ", ".join(f"{key} {value:.2f}" for key, value in figures.items()))
    ratios = (result["cpu_single_over_guessing"], result["cpu_plain_over_guessing"])
    print(f"CPU time of a generation: single {ratios[0]:.2f}, plain {ratios[1]:.2f} times that with guesses")


if __name__ == "__main__":
    sys.exit(main())
