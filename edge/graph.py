"""One ONNX graph in ONNX Runtime, opened from verified bytes and held to its contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from edge.manifest import ArtifactError, Artifacts

Array = npt.NDArray[np.generic]

_ORT_TYPES = {"tensor(float)": "float", "tensor(int64)": "int64", "tensor(uint8)": "uint8"}


class GraphError(RuntimeError):
    """ONNX Runtime failed while running a graph."""


class Graph:
    """A session on the CPU with a stated number of threads.

    Opened from the bytes whose hash was checked, so a file that changes meanwhile cannot be run.
    """

    def __init__(self, artifacts: Artifacts, name: str, *, threads: int) -> None:
        contract = artifacts.graphs[name]
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # A spinning worker would take the core that the other thread needs.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        # Opened from bytes, a graph would read external weights from the working directory: from a folder that is
        # not there it can read none, and fails to open.
        nowhere = str(artifacts.directory / "no-external-data")
        options.add_session_config_entry("session.model_external_initializers_file_folder_path", nowhere)
        try:
            self._session = ort.InferenceSession(
                artifacts.contents[contract.file], sess_options=options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise ArtifactError(
                f"{contract.file}: ONNX Runtime cannot open it ({str(error).splitlines()[0]})"
            ) from error
        self.name = name
        for declared, found in (
            (contract.inputs, self._session.get_inputs()),
            (contract.outputs, self._session.get_outputs()),
        ):
            promised = [(t.name, t.dtype, t.shape) for t in declared]
            actual = [(t.name, _ORT_TYPES.get(t.type, t.type), tuple(t.shape)) for t in found]
            if promised != actual:
                raise ArtifactError(f"{contract.file}: its inputs or outputs are not those of the manifest")
        self.input_names = [t.name for t in contract.inputs]
        self.output_names = [t.name for t in contract.outputs]

    def run(self, feeds: Mapping[str, Array], outputs: Sequence[str] | None = None) -> list[Array]:
        """Outputs (all, or those named) for named inputs; raises GraphError."""
        try:
            result: list[Array] = self._session.run(outputs, feeds)
        except Exception as error:
            raise GraphError(f"{self.name}: {str(error).splitlines()[0]}") from error
        return result
