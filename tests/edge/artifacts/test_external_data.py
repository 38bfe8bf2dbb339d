"""The reader of external data finds every tensor that onnx could, and takes any bytes."""

from __future__ import annotations

import contextlib
import tracemalloc

import onnx
import pytest
from google.protobuf.descriptor import Descriptor
from hypothesis import given
from hypothesis import strategies as st
from onnx import helper

from edge.artifacts import external_data as module
from edge.artifacts.external_data import (
    FIELDS,
    MAX_DEPTH,
    MAX_ENTRY_BYTES,
    TENSOR,
    ExternalData,
    ExternalDataError,
    external_data,
)

GRAPH, NODE, ATTRIBUTE, SUBGRAPH = (bytes([number << 3 | 2]) for number in (7, 1, 5, 6))
"""Tags of a model's graph, its nodes, their attributes, and the graph in an attribute."""


def field(tag: bytes, body: bytes) -> bytes:
    """A length-delimited field."""
    size, length = len(body), bytearray()
    while size >= 0x80:
        length.append(size & 0x7F | 0x80)
        size >>= 7
    return tag + bytes([*length, size]) + body


def paths_to_tensors() -> dict[str, dict[int, str]]:
    """From onnx's own description of its messages: the fields from which a TensorProto can be reached."""
    inside: dict[str, dict[int, str]] = {}
    waiting: list[Descriptor] = [onnx.ModelProto.DESCRIPTOR]
    while waiting:
        message = waiting.pop()
        if message.name not in inside:
            parts = [field for field in message.fields if field.message_type is not None]
            inside[message.name] = {field.number: field.message_type.name for field in parts}
            waiting += [field.message_type for field in parts]
    reaching = {TENSOR}
    while True:
        more = {name for name, fields in inside.items() if reaching & set(fields.values())} - reaching
        if not more:
            break
        reaching |= more
    return {
        name: {number: kind for number, kind in inside[name].items() if kind in reaching}
        for name in reaching - {TENSOR}
    }


def test_no_place_where_a_tensor_can_sit_is_overlooked() -> None:
    assert {name: dict(fields) for name, fields in FIELDS.items()} == paths_to_tensors()


def outside(location: str) -> onnx.TensorProto:
    tensor = onnx.TensorProto(name=location, data_type=1, dims=[2], data_location=onnx.TensorProto.EXTERNAL)
    for key, value in (("location", location), ("offset", "16"), ("length", "8")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    return tensor


def test_tensors_are_found_in_initializers_attributes_subgraphs_and_functions() -> None:
    branch = helper.make_graph([helper.make_node("Constant", [], ["c"], value=outside("branch"))], "b", [], [])
    nodes = [
        helper.make_node("Constant", [], ["a"], value=outside("attribute")),
        helper.make_node("If", ["a"], ["d"], then_branch=branch, else_branch=branch),
    ]
    graph = helper.make_graph(
        nodes, "g", [], [], initializer=[outside("initializer"), helper.make_tensor("x", 1, [1], [1])]
    )
    function = helper.make_function(
        "ours", "f", [], ["y"], [helper.make_node("Constant", [], ["y"], value=outside("function"))], []
    )
    model = helper.make_model(graph, functions=[function])
    found = sorted(external_data(model.SerializeToString()), key=lambda data: data.location)
    places = ["attribute", "branch", "branch", "function", "initializer"]
    assert found == [ExternalData(place, 16, 8) for place in places]


def test_a_graph_given_twice_hides_nothing() -> None:
    """Protobuf merges a field that comes twice; so both must be read."""
    first = onnx.ModelProto(graph=helper.make_graph([], "g", [], []))
    second = onnx.ModelProto(graph=helper.make_graph([], "g", [], [], initializer=[outside("hidden")]))
    merged = first.SerializeToString() + second.SerializeToString()
    assert len(onnx.ModelProto.FromString(merged).graph.initializer) == 1
    assert [data.location for data in external_data(merged)] == ["hidden"]


@pytest.mark.slow
def test_a_graph_of_empty_nodes_takes_no_multiple_of_its_size_in_memory() -> None:
    model = field(GRAPH, field(NODE, b"") * 20_000)
    tracemalloc.start()
    try:
        assert not list(external_data(model))
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < len(model)


def test_a_model_of_endless_fields_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_FIELDS", 1000)
    assert not list(external_data(field(GRAPH, field(NODE, b"") * 999)))
    with pytest.raises(ExternalDataError, match="more than 1000 fields"):
        list(external_data(field(GRAPH, field(NODE, b"") * 1000)))


@pytest.mark.parametrize("levels", [MAX_DEPTH // 3 - 1, MAX_DEPTH // 3 + 1])
def test_graphs_are_nested_up_to_a_limit(levels: int) -> None:
    graph = b""
    for _ in range(levels):
        graph = field(NODE, field(ATTRIBUTE, field(SUBGRAPH, graph)))
    refused = pytest.raises(ExternalDataError, match="nested deeper than 100 levels")
    with refused if levels > MAX_DEPTH // 3 else contextlib.nullcontext():
        assert not list(external_data(field(GRAPH, graph)))


def test_a_long_entry_of_external_data_is_refused() -> None:
    model = onnx.ModelProto(
        graph=helper.make_graph([], "g", [], [], initializer=[outside("w" * (MAX_ENTRY_BYTES + 1))])
    )
    with pytest.raises(ExternalDataError, match=r"external data of \d+ bytes, expected at most 1024"):
        list(external_data(model.SerializeToString()))


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    try:
        list(external_data(data))
    except ExternalDataError as error:
        assert "\n" not in str(error)


@given(st.data())
def test_a_damaged_model_is_read_or_refused(data: st.DataObject) -> None:
    model = onnx.ModelProto(graph=helper.make_graph([], "g", [], [], initializer=[outside("w")])).SerializeToString()
    damaged = bytearray(model)
    damaged[data.draw(st.integers(0, len(model) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(ExternalDataError):
        list(external_data(bytes(damaged)))


@pytest.mark.parametrize("data", [b"\x0b", b"\x3a\xff\xff\xff\xff\x0f", b"\x08" + b"\xff" * 10, b"\x3a"], ids=bytes.hex)
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(ExternalDataError, match="not an ONNX model"):
        list(external_data(data))
