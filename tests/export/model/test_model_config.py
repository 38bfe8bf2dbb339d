"""A network's numbers from a preset, a file or overrides; what is misspelt or of another type is refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from export.model.config import PRESETS, ModelConfigError, config_for, config_from_file, with_overrides

NANO = PRESETS["nano"]


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_preset_written_to_a_file_reads_back_the_same(tmp_path: Path, name: str) -> None:
    path = tmp_path / "model.json"
    path.write_text(json.dumps(PRESETS[name].to_dict()), encoding="utf-8")
    assert config_for(str(path)) == config_for(name) == PRESETS[name]


def test_missing_sizes_are_those_of_the_paper(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text('{"name": "shallow", "action": {"layers": 3}}', encoding="utf-8")
    config = config_from_file(path)
    assert (config.action.layers, config.vision) == (3, PRESETS["1b"].vision)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("[]", "expected a table"),
        ("{}", "key 'name' is missing"),
        ('{"name": ""}', "name is empty"),
        ('{"name": "x", "colour": 1}', "unknown key 'colour'; expected one of: action, language"),
        ('{"name": "x", "action": []}', "action: expected a table"),
        ('{"name": "x", "action": {"layer": 3}}', "action: unknown key 'layer'; did you mean layers"),
        ('{"name": "x", "action": {"layers": "3"}}', "layers: expected a whole number, found '3'"),
        ('{"name": "x", "action": {"layers": true}}', "layers: expected a whole number, found True"),
        ('{"name": "x", "action": {"layers": 0}}', "layers is 0, expected 1 to"),
        ('{"name": "x", "action": {"layers": 1e99}}', "layers: expected a whole number, found 1e[+]99"),
        ('{"name": "x", "action": {"step_s": NaN}}', "step_s: expected a finite number, found nan"),
        ('{"name": "x", "vision": {"mean": [1, 2]}}', "expected a list of 3 values"),
        ('{"name": "x", "language": {"im_end_id": -1}}', "special ids"),
        ('{"name": "x", "vision": {"token_dim": 64}}', "token_dim 64 must equal"),
    ],
)
def test_a_file_that_is_no_configuration_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "model.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ModelConfigError, match=message) as caught:
        config_from_file(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_and_an_unknown_preset_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelConfigError, match="cannot be read"):
        config_for(str(tmp_path / "absent.json"))
    with pytest.raises(ModelConfigError, match="'7b' is not known; expected one of: 1b, nano"):
        config_for("7b")


def test_overrides_are_parsed_by_the_type_of_their_field() -> None:
    config = with_overrides(
        NANO,
        {
            "action.layers": "3",
            "action.semantic_interface": "values-only",
            "action.latency_aware": "false",
            "action.step_s": "1",
            "vision.stem_channels": "8,16,32,64",
            "vision.mean": "[0.5, 0.5, 0.5]",
        },
    )
    assert (config.action.layers, config.action.semantic_interface) == (3, "values-only")
    assert (config.action.latency_aware, config.action.step_s) == (False, 1.0)
    assert (config.vision.stem_channels, config.vision.mean) == ((8, 16, 32, 64), (0.5, 0.5, 0.5))
    assert config.language == NANO.language


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("action.layer", "3", "action.layer is not a number of the model; did you mean action.layers"),
        ("name", "x", "name is not a number of the model"),
        ("layers", "3", "layers is not a number of the model; did you mean .*action.layers"),
        ("action.layers", "three", "action: layers: expected a whole number, found 'three'"),
        ("action.layers", "2.5", "action: layers: expected a whole number, found '2.5'"),
        ("action.latency_aware", "yes", "action: latency_aware: expected true or false"),
        ("action.semantic_interface", "telepathy", "expected one of"),
        ("vision.stem_channels", "8,x", "expected a whole number, found 'x'"),
    ],
)
def test_an_override_that_fits_no_field_is_refused(key: str, text: str, message: str) -> None:
    with pytest.raises(ModelConfigError, match=message):
        with_overrides(NANO, {key: text})
