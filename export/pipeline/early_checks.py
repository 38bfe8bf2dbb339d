"""Checks of an export's settings before anything is built: what the finished directory would be refused for."""

from __future__ import annotations

import json
from fnmatch import fnmatchcase

from edge.artifacts.files import MANIFEST_NAME, ArtifactError
from edge.artifacts.manifest import HORIZON_S, LANGUAGE_PAIR
from edge.artifacts.runtime import check_agreement, read_runtime
from export.graphs.build import linear_layers
from export.model.config import TicVlaConfig
from export.pipeline.artifacts import manifest_runtime
from export.plan.plan import Plan, PlanError
from export.quantize.precision import PrecisionError
from export.targets.file import Target

SHOWN_LAYERS = 3


def check_settings(target: Target, config: TicVlaConfig, made: Plan) -> None:
    """Refuse settings that the runner's loader would refuse. Raises PlanError or PrecisionError with one line."""
    action, (least_s, most_s) = config.action, HORIZON_S
    horizon_s = action.steps * action.step_s
    if not least_s <= horizon_s <= most_s:
        raise PlanError(
            f"a trajectory of model.action.steps={action.steps} with model.action.step_s={action.step_s:g} is "
            f"{horizon_s:g} s long, the runner accepts {least_s:g} to {most_s:g} s: set one of the two"
        )
    manifest = {
        "model": {"config": config.to_dict()},
        "plan": made.to_dict(),
        "provenance": {"target": target.to_dict()},
    }
    try:
        # Through JSON, as the loader reads it.
        runtime = read_runtime(json.loads(json.dumps(manifest_runtime(target, config, made))))
        check_agreement(manifest, runtime, action.steps)
    except ArtifactError as error:
        line = str(error).removeprefix(f"{MANIFEST_NAME}: ")
        raise PlanError(f"the runner would refuse this export: {line}") from error
    for graph in target.graph_names:
        _check_overrides(target, config, graph)


def _check_overrides(target: Target, config: TicVlaConfig, graph: str) -> None:
    """Refuse an exception that matches no layer: it is a typing error, and the layer that it means would be rounded."""
    # An exception of `language_model` is given to both graphs of a pair; the head is only in one of them.
    together = LANGUAGE_PAIR if graph in LANGUAGE_PAIR else (graph,)
    layers = [layer for name in together for layer in linear_layers(config, name)]
    for pattern, _ in target.precision(graph).overrides:
        if not any(fnmatchcase(layer, pattern) for layer in layers):
            raise PrecisionError(
                f"graphs.{graph}.overrides.{pattern}: no layer has this name; expected a pattern of names such as "
                f"{', '.join(layers[:SHOWN_LAYERS])}"
            )
