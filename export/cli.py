"""`edge-export`: build verified artifacts for a target, or verify what is there."""

from __future__ import annotations

import argparse
import re
import resource
import sys
import time
from pathlib import Path
from typing import Any

import torch

from edge.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED, check_result_target, write_result
from edge.manifest import ArtifactError
from export.artifacts import Export, GateError, build_artifacts, verify_directory
from export.measure import measure_plan
from export.model.network import build
from export.model.weights import WeightsError, WeightsInfo, load_weights, preset, save_weights
from export.target import TargetError, list_targets, load_target

EXAMPLES = """examples:
  edge-export --target cpu --model nano --out out/nano
  edge-export --target cpu --model nano --checkpoint nano.safetensors --out out/nano
  edge-export verify out/nano
  edge-export --list-targets

exit codes: 0 done, 1 a graph is not the same model, 2 bad arguments or input, 130 interrupted
"""


class UsageError(ValueError):
    """Arguments that do not go together."""


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-export`."""
    p = argparse.ArgumentParser(
        "edge-export", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument(
        "command", nargs="?", choices=["verify"], help="verify DIR: hashes, I/O contract and parity once more"
    )
    p.add_argument("directory", nargs="?", type=Path, metavar="DIR", help="directory for verify")
    p.add_argument("--target", default="cpu", help="device to export for (default: cpu)")
    p.add_argument("--list-targets", action="store_true", help="list the targets and exit")
    p.add_argument("--model", default="nano", help="preset (default: nano; 1b is not exported yet)")
    source = p.add_mutually_exclusive_group()
    source.add_argument("--checkpoint", type=Path, metavar="PATH", help="weights as safetensors (see --save-weights)")
    source.add_argument(
        "--random-weights", type=int, metavar="SEED", help="untrained weights of this seed (default: 0)"
    )
    p.add_argument("--save-weights", type=Path, metavar="PATH", help="also write the weights as safetensors")
    p.add_argument("--out", type=Path, metavar="DIR", help="artifact directory to write")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def _load(args: argparse.Namespace, target_name: str, model_name: str) -> Export:
    target, config = load_target(target_name), preset(model_name)
    if config.name != "nano":
        raise WeightsError(f"model {config.name!r} has no tokenizer in this version; expected: nano")
    if args.checkpoint is not None:
        model, info = load_weights(args.checkpoint, config)
        return Export(target, model, info)
    seed = 0 if args.random_weights is None else args.random_weights
    if not 0 <= seed < 2**63:
        raise WeightsError(f"--random-weights {seed}: expected a seed between 0 and 2^63 - 1")
    return Export(target, build(config, seed), WeightsInfo(trained=False, origin=f"random seed {seed}"))


def _rebuilder(args: argparse.Namespace) -> Any:
    def rebuild(manifest: dict[str, Any]) -> Export:
        seed = re.fullmatch(r"random seed (\d{1,19})", str(manifest["provenance"].get("weights_origin", "")))
        if args.checkpoint is None and args.random_weights is None and seed is not None:
            args.random_weights = int(seed[1])
        return _load(args, str(manifest["target"]), str(manifest["model"].get("name")))

    return rebuild


def _say(line: str) -> None:
    sys.stderr.write(f"edge-export: {line}\n")


def _run(args: argparse.Namespace) -> dict[str, Any]:
    if args.command == "verify":
        if args.directory is None:
            raise UsageError("verify: which directory? expected: edge-export verify DIR")
        manifest = verify_directory(args.directory, _rebuilder(args), _say)
        return _result(manifest)
    if args.out is None:
        raise UsageError("--out is missing: expected a directory to write, e.g. --out out/nano")
    check_result_target(args.json)
    args.out = args.out.absolute()
    if not args.out.name:
        raise UsageError(f"--out {args.out}: expected a directory that can be made")
    export = _load(args, args.target, args.model)
    if not export.info.trained:
        _say(f"weights are untrained ({export.info.origin}): the robot will move, it will not navigate")
    if args.save_weights is not None:
        save_weights(export.model, args.save_weights, export.info)
    manifest = build_artifacts(export, args.out, _say)
    return {**_result(manifest), "plan": measure_plan(args.out), "out": str(args.out)}


def _result(manifest: dict[str, Any]) -> dict[str, Any]:
    graphs = {
        name: {
            "params": graph["params"],
            "bytes": manifest["files"][graph["file"]]["bytes"],
            "precision": graph["precision"],
            "parity": graph["parity"],
        }
        for name, graph in manifest["graphs"].items()
    }
    return {"target": manifest["target"], "model": manifest["model"]["name"], "graphs": graphs}


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    started_ns = time.monotonic_ns()
    if args.list_targets:
        for name in list_targets():
            sys.stdout.write(f"{name}\t{load_target(name).description}\n")
        return EXIT_DONE
    # One thread: the order of floating-point sums, and with it every reported number, is then the same on each run.
    torch.set_num_threads(1)
    try:
        result = _run(args)
        result["peak_rss_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        result["wall_s"] = (time.monotonic_ns() - started_ns) / 1e9
        write_result(args.json, result)
    except GateError as error:
        _say(str(error))
        return EXIT_CHECK_FAILED
    except (UsageError, ArtifactError, WeightsError, TargetError, OSError) as error:
        _say(str(error))
        # An artifact that does not verify is a failed check; anything else here is bad input.
        return EXIT_CHECK_FAILED if args.command == "verify" and isinstance(error, ArtifactError) else EXIT_BAD_INPUT
    except KeyboardInterrupt:
        _say("interrupted")
        return EXIT_INTERRUPTED
    if args.json != "-":
        for name, graph in result["graphs"].items():
            parity = graph["parity"]
            _say(f"{name}: {graph['params']:,} parameters, cosine {parity['cosine']:.7f}, {parity['verdict']}")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
