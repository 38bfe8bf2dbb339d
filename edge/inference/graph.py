"""Opens one ONNX graph in ONNX Runtime from verified bytes and checks it against its contract."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, TensorContract
from edge.artifacts.providers import opened_with
from edge.core.device import OPENVINO

if TYPE_CHECKING:
    import onnxruntime as ort  # an extra: loaded where a graph is opened, so that the installer runs without it

Array = npt.NDArray[np.generic]

CONTEXT_AXIS = "T"
"""Free axis along which a semantic state grows, up to the model's context."""
CPU_PROVIDER = "CPUExecutionProvider"
DTYPES: dict[str, type[np.generic]] = {
    "float": np.float32,
    "float16": np.float16,
    "int32": np.int32,
    "int64": np.int64,
    "uint8": np.uint8,
}
_ORT_TYPES = {f"tensor({name})": name for name in DTYPES}
_DEVICES = {"CUDAExecutionProvider": "cuda", "TensorrtExecutionProvider": "cuda"}


class GraphError(RuntimeError):
    """ONNX Runtime failed while running a graph."""


class CancelledError(Exception):
    """A generation was stopped on request."""


class Interrupt:
    """Ends calls from another thread, also in the middle of one; it belongs to one generation and stays set.

    ONNX Runtime checks it between two nodes of a graph, so a compiled engine, which is one node, is finished first.
    """

    def __init__(self) -> None:
        import onnxruntime as ort

        self.options = ort.RunOptions()
        self.options.log_severity_level = 4  # the caller reports the end of a call
        self.is_set = False

    def set(self) -> None:
        """End the call under way and every later one."""
        self.is_set = True
        self.options.terminate = True


class Binding:
    """Buffers that a graph reads and writes; the caller keeps their arrays alive.

    Binding copies an input to an accelerator, which can fail like a run: with a GraphError.
    """

    def __init__(self, graph: str, buffers: ort.IOBinding) -> None:
        self._graph = graph
        self.buffers = buffers

    def bind_ortvalue_input(self, name: str, value: ort.OrtValue) -> None:
        """Read an input from a buffer."""
        try:
            self.buffers.bind_ortvalue_input(name, value)
        except Exception as error:
            raise GraphError(f"{self._graph}: input {name}: {str(error).splitlines()[0]}") from error

    def bind_ortvalue_output(self, name: str, value: ort.OrtValue) -> None:
        """Write an output to a buffer."""
        try:
            self.buffers.bind_ortvalue_output(name, value)
        except Exception as error:
            raise GraphError(f"{self._graph}: output {name}: {str(error).splitlines()[0]}") from error


def session_settings(
    artifacts: Artifacts,
    name: str,
    *,
    threads: int | None = None,
    provider: str | None = None,
    cores: Collection[int] = (),
) -> tuple[ort.SessionOptions, list[tuple[str, dict[str, str]]]]:
    """Return the options of a graph's session, and its provider with its options; the arguments are those of Graph."""
    import onnxruntime as ort

    contract = artifacts.graphs[name]
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads or contract.session.threads or 1
    if cores and options.intra_op_num_threads > 1:
        # The calling thread is the first of them; ONNX Runtime counts processors from 1.
        worker = ",".join(str(core + 1) for core in sorted(cores))
        affinities = ";".join([worker] * (options.intra_op_num_threads - 1))
        options.add_session_config_entry("session.intra_op_thread_affinities", affinities)
    options.inter_op_num_threads = 1
    if any(CONTEXT_AXIS in tensor.shape for tensor in contract.inputs):
        # ONNX Runtime keeps a plan of memory for every length of the context that it has seen: some KiB each.
        options.enable_mem_pattern = False
    # A spinning worker would occupy the other thread's core.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    # A graph opened from bytes would read external weights from the working directory. It may read them from its
    # own directory if the manifest lists them; otherwise point it at a folder that does not exist.
    weights = artifacts.directory if contract.data_files else artifacts.directory / "no-external-data"
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(weights))
    chosen = provider or contract.session.provider
    given = contract.session.options if provider is None else {}
    if chosen == OPENVINO:
        # It would leave nodes that it does not know to ONNX Runtime without a message.
        options.add_session_config_entry("session.disable_cpu_ep_fallback", "1")
    return options, [(chosen, opened_with(chosen, given, options.intra_op_num_threads))]


class Graph:
    """A session with the execution provider and threads of the manifest, or of an argument.

    It is opened from the bytes whose hash was checked, so a file that changes meanwhile cannot run. Weights in data
    files are mapped, not read; the files' identity is checked again once the session has opened them.
    """

    def __init__(
        self,
        artifacts: Artifacts,
        name: str,
        *,
        threads: int | None = None,
        provider: str | None = None,
        cores: Collection[int] = (),
        interrupt: Interrupt | None = None,
    ) -> None:
        """`cores`: cores of the session's worker threads; empty: those of the opening thread.

        `interrupt` ends every call that is given none of its own.
        """
        import onnxruntime as ort

        contract = artifacts.graphs[name]
        self.provider = provider or contract.session.provider
        if self.provider not in ort.get_available_providers():
            raise ArtifactError(
                f"{contract.file}: made for {self.provider}, this ONNX Runtime has {ort.get_available_providers()}; "
                f"install the package that brings it or export for another target"
            )
        options, providers = session_settings(artifacts, name, threads=threads, provider=provider, cores=cores)
        try:
            self._session = ort.InferenceSession(
                artifacts.contents[contract.file], sess_options=options, providers=providers
            )
        except Exception as error:
            raise ArtifactError(
                f"{contract.file}: ONNX Runtime cannot open it ({str(error).splitlines()[0]})"
            ) from error
        artifacts.check_unchanged(contract.data_files)
        opened = self._session.get_providers()[0]
        if opened != self.provider:
            # ONNX Runtime replaces a provider whose libraries do not load by the CPU's, with one line in the log.
            raise ArtifactError(
                f"{contract.file}: ONNX Runtime opened it on {opened} instead of {self.provider}, whose libraries are "
                f"missing or do not load; install those that its package names"
            )
        self.name = name
        self._interrupt = interrupt
        self.contract = contract
        for declared, found in (
            (contract.inputs, self._session.get_inputs()),
            (contract.outputs, self._session.get_outputs()),
        ):
            promised = [(t.name, t.dtype, t.shape) for t in declared]
            actual = [(t.name, _ORT_TYPES.get(t.type, t.type), tuple(t.shape)) for t in found]
            if promised != actual:
                raise ArtifactError(f"{contract.file}: its inputs or outputs are not those of the manifest")
            for tensor in declared:
                if tensor.dtype not in DTYPES:
                    raise ArtifactError(
                        f"{contract.file}: {tensor.name} is {tensor.dtype}, expected one of {', '.join(DTYPES)}"
                    )
        self.input_names = [t.name for t in contract.inputs]
        self.output_names = [t.name for t in contract.outputs]

    @property
    def device(self) -> str:
        """Device of the graph's large buffers, by ONNX Runtime's name: `cpu` or `cuda`."""
        return _DEVICES.get(self.provider, "cpu")

    def run(
        self, feeds: Mapping[str, Array], outputs: Sequence[str] | None = None, interrupt: Interrupt | None = None
    ) -> list[Array]:
        """Return outputs (None: all) for named inputs; raises GraphError, or CancelledError when interrupted."""
        interrupt = interrupt or self._interrupt
        try:
            result: list[Array] = self._session.run(outputs, feeds, interrupt.options if interrupt else None)
        except Exception as error:
            raise self._failure(error, interrupt) from error
        return result

    def binding(self) -> Binding:
        """Return a new set of bound buffers for `run_bound`."""
        return Binding(self.name, self._session.io_binding())

    def run_bound(self, binding: Binding, interrupt: Interrupt | None = None) -> None:
        """Run on bound buffers, in place where an input and an output share one; raises as `run` does."""
        interrupt = interrupt or self._interrupt
        try:
            self._session.run_with_iobinding(binding.buffers, interrupt.options if interrupt else None)
        except Exception as error:
            raise self._failure(error, interrupt) from error

    def _failure(self, error: Exception, interrupt: Interrupt | None) -> Exception:
        if interrupt is not None and interrupt.is_set:
            return CancelledError(self.name)
        return GraphError(f"{self.name}: {str(error).splitlines()[0]}")


def zeros(contract: TensorContract, **axes: int) -> Array:
    """Return a buffer of zeros in a tensor's shape with the given free axes."""
    shape = [axis if isinstance(axis, int) else axes[axis] for axis in contract.shape]
    return np.zeros(shape, dtype=DTYPES[contract.dtype])
