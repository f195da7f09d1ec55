"""torch, the default runtime of checkpoints: their network as a traced graph, or TorchScript; CPU or CUDA."""

from __future__ import annotations

import collections
import copy
import json
import logging
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vision.foreign.layouts import ForeignFacts, recognise_by_metadata
from vision.runtimes import base
from vision.runtimes.base import Device, Precision, RuntimeName, RuntimeUnusableError
from vision.runtimes.exported import KEY, ExportedFacts, not_ours, own_facts
from vision.runtimes.network import Network
from vision.runtimes.stored_choice import StoredChoice
from vision.yolo.architecture import YoloModel
from vision.yolo.level_outputs import Head, LevelOutput, Product

logger = logging.getLogger(__name__)

Graph = Callable[[Tensor], tuple[Tensor, ...]]
_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
_CUDA_DTYPES = {**_DTYPES, "float16": torch.float16}
# For graphs valid for one size only. A camera has one size; a folder of photographs a few.
_MOST_GRAPHS = 4
# Input sizes for tracing and for checking the graph, in strides: height and width.
_LARGEST_METADATA_BYTES = 1 << 20
_TRACED, _TRIED = (2, 4), (4, 6)
# Enough to distinguish two precisions: as many pairs of runs as fit. Measured once, see `StoredChoice`.
_TRIAL_PAIRS = range(5, 40)
_TRIAL_S = 0.5  # of processor time
_TRIAL_WALL_S = 3.0
# Least share of pairs that agree with the choice; of 20 measurements beside other load the least was 0.97.
_AGREEING = 0.75
_TRIAL_SIDE = 320
# Of the calls before the first frame: the second of a GPU's also compiles, for each size.
_WARM_UP_RUNS = {"cpu": 2, "cuda": 4}
# bfloat16 must save at least a fifth; for less it is not worth its rounding.
_WORTH = 0.8


def torch_product(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """`a @ b` with torch's threads: numpy's thread pool would compete with them."""
    with torch.inference_mode():
        product: NDArray[np.float32] = (torch.from_numpy(a) @ torch.from_numpy(b)).numpy()
    return product


class TorchRuntime:
    """A model on torch. See `base.Runtime`.

    Args:
        model: is modified.
        class_ids: sorted; the only classes to compute. None: all.
        precision: `auto` selects bfloat16 only if the processor supports it (a fifth less time).
        threads: processor threads, of torch in the whole process; None: unchanged.
        sparse_boxes: see `Network`.
        model_sha256: of the weights; with it, a measured precision is stored for later starts.
        device: `cuda`: torch's current CUDA device; there `auto` is float32, without TF32 (in the whole
            process), so that boxes equal the processor's.

    Raises:
        RuntimeUnusableError: no such device or precision, or the GPU's memory is full (`infer` too).
    """

    product: Product = staticmethod(torch_product)
    name: RuntimeName = "torch"

    def __init__(
        self,
        model: YoloModel,
        *,
        class_ids: Sequence[int] | None = None,
        precision: Precision = "auto",
        threads: int | None = None,
        sparse_boxes: bool = False,
        model_sha256: str | None = None,
        device: Device = "cpu",
    ) -> None:
        check_device(device)
        dtypes = _DTYPES if device == "cpu" else _CUDA_DTYPES
        if precision not in ("auto", *dtypes):
            raise RuntimeUnusableError(
                f"torch computes in {' or '.join(dtypes)} on {device}, not in {precision}"
            )
        self.device = torch.device(device)
        if threads is not None:
            torch.set_num_threads(threads)
        # On a GPU the boxes of all cells cost less than copying the neck's features from it.
        sparse_boxes = sparse_boxes and device == "cpu"
        self._network = Network(model, class_ids, sparse_boxes=sparse_boxes).channels_last()
        self.head: Head = self._network.head
        self.precision, self.precision_reason = self._choose_precision(precision, model_sha256)
        self._graphs: collections.OrderedDict[tuple[int, int], Graph] = collections.OrderedDict()
        with gpu_errors():
            if device == "cuda":
                # Its 10 bits of mantissa are those of float16, which can be asked for by its name.
                torch.backends.cudnn.allow_tf32 = False
                self.precision_reason += f", on {torch.cuda.get_device_name()}"
            self._network.in_precision(dtypes[self.precision]).to(self.device)
            self._graph = self._any_size()

    @property
    def threads(self) -> int:
        return torch.get_num_threads()

    def prepare(self, height: int, width: int) -> None:
        # The graph's first runs allocate its memory; later ones only compute.
        blank = np.zeros((height, width, 3), np.uint8)
        for _ in range(_WARM_UP_RUNS.get(self.device.type, 2)):
            self.infer(blank)

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        with torch.inference_mode(), gpu_errors():
            pixels = torch.from_numpy(image_bgr).unsqueeze(0).to(self.device)
            graph = self._graph or self._graph_of_size(pixels)
            outputs = [level[0].cpu().numpy() for level in graph(pixels)]
        return self.head.levels(outputs)

    def _any_size(self) -> Graph | None:
        """One graph for inputs of every size; None if the tracer made a size constant."""
        stride = max(self.head.strides)
        # Noise, so that outputs that were split and concatenated wrongly differ.
        noise = torch.Generator().manual_seed(0)
        shown, checked = (
            torch.randint(256, (1, high * stride, wide * stride, 3), generator=noise, dtype=torch.uint8).to(
                self.device
            )
            for high, wide in (_TRACED, _TRIED)
        )
        graph = traced(self._network, shown)
        with torch.inference_mode():
            expected = self._network(checked)
            try:
                found = graph(checked)
            except RuntimeError as error:
                logger.debug("the graph is valid for one input size only: %s", error)
                return None
        pairs = zip(expected, found, strict=True)
        same = all(a.shape == b.shape and torch.allclose(a, b, 0.01, 0.01) for a, b in pairs)
        return graph if same else None

    def _graph_of_size(self, pixels: Tensor) -> Graph:
        size = (pixels.shape[1], pixels.shape[2])
        graph = self._graphs.get(size)
        if graph is None:
            started = time.perf_counter()
            graph = self._graphs[size] = traced(self._network, pixels)
            logger.debug("graph for %dx%d in %.2f s", size[1], size[0], time.perf_counter() - started)
            if len(self._graphs) > _MOST_GRAPHS:
                self._graphs.popitem(last=False)
        elif len(self._graphs) > 1:
            self._graphs.move_to_end(size)
        return graph

    def _choose_precision(self, requested: Precision, model_sha256: str | None) -> tuple[str, str]:
        on_cuda = self.device.type == "cuda"
        native = base.bfloat16_instructions()
        if requested == "bfloat16":
            supported = torch.cuda.is_bf16_supported(including_emulation=False) if on_cuda else native
            if not supported:
                which = "GPU" if on_cuda else "processor"
                logger.warning("this %s does not support bfloat16; it is emulated and slow", which)
        if requested != "auto":
            return requested, "as requested"
        if self.device.type != "cpu":
            return "float32", f"the default on {self.device}"
        if not native:
            return "float32", "this processor does not support bfloat16"
        stored = None
        if model_sha256 is not None:
            stored = StoredChoice(model_sha256, {"torch": torch.__version__, "precisions": list(_DTYPES)})
        times = stored.read(set(_DTYPES)) if stored is not None else None
        if times is not None:
            return _faster(times), f"measured before: {_in_words(times)} ({native})"
        pairs = self._measured_ms(*_DTYPES.values())
        times = dict(zip(_DTYPES, map(min, zip(*pairs, strict=True)), strict=True))
        text, chosen = f"{_in_words(times)} ({native})", _faster(times)
        agreeing = sum(_faster(dict(zip(_DTYPES, pair, strict=True))) == chosen for pair in pairs)
        if agreeing < _AGREEING * len(pairs):
            return "bfloat16", (
                f"measured now, not clearly: {text}, but {agreeing} of {len(pairs)} pairs agree; "
                "the processor supports it"
            )
        if stored is not None:
            stored.write(times)
        return chosen, f"measured now: {text}"

    def _measured_ms(self, *dtypes: torch.dtype) -> list[tuple[float, ...]]:
        """The processor times of a small input in each dtype, measured alternately.

        On one thread: beside other load, several wait for each other and spend processor time on it, which
        made bfloat16 slower or faster by chance.
        """
        pixels = torch.zeros(1, _TRIAL_SIDE, _TRIAL_SIDE, 3, dtype=torch.uint8)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with torch.inference_mode():
                graphs = [
                    traced(copy.deepcopy(self._network).in_precision(dtype), pixels) for dtype in dtypes
                ]
                for graph in graphs * 2:
                    graph(pixels)  # its first runs allocate its memory
                pairs: list[tuple[float, ...]] = []
                began, began_wall = time.thread_time(), time.perf_counter()
                while len(pairs) < _TRIAL_PAIRS.stop and (
                    len(pairs) < _TRIAL_PAIRS.start
                    or (
                        time.thread_time() - began < _TRIAL_S
                        and time.perf_counter() - began_wall < _TRIAL_WALL_S
                    )
                ):
                    pairs.append(tuple(_spent_ms(graph, pixels) for graph in graphs))
        finally:
            torch.set_num_threads(threads)
        return pairs


def _faster(times: Mapping[str, float]) -> str:
    """The precision to use, by the times of both."""
    return "bfloat16" if times["bfloat16"] < _WORTH * times["float32"] else "float32"


def _in_words(times: Mapping[str, float]) -> str:
    return f"{times['float32']:.1f} ms in float32, {times['bfloat16']:.1f} ms in bfloat16"


def _spent_ms(graph: Graph, pixels: Tensor) -> float:
    """Processor time of this thread for one run."""
    started = time.thread_time()
    graph(pixels)
    return (time.thread_time() - started) * 1e3


def check_device(device: Device) -> None:
    """Raise `RuntimeUnusableError` if torch cannot compute on it."""
    if device != "cuda":
        return
    with warnings.catch_warnings(record=True) as said:  # torch warns of a driver that it cannot use
        warnings.simplefilter("always")
        available = torch.cuda.is_available()
    if available:
        return
    built = torch.version.cuda
    if built is None:
        reason, do = "it is built without CUDA", "install a torch built for CUDA"
    else:
        reason = "; ".join(" ".join(str(warning.message).split())[:200] for warning in said)
        reason = reason or f"it is built for CUDA {built}"
        do = "check the driver (nvidia-smi) and CUDA_VISIBLE_DEVICES"
    raise RuntimeUnusableError(
        f"device cuda: torch {torch.__version__} finds no CUDA device ({reason}); use the device cpu, or {do}"
    )


@contextmanager
def gpu_errors() -> Iterator[None]:
    """Raise what torch reports of a GPU as a `RuntimeUnusableError` of one line."""
    try:
        yield
    except RuntimeError as error:
        # From a traced graph it is a plain RuntimeError that quotes the operation's.
        line = next((line for line in str(error).splitlines() if "CUDA" in line or "cuDNN" in line), None)
        if line is None:
            raise
        if "out of memory" in line:
            line = "out of memory; use a smaller image_size or model, or end other programs on the GPU"
        raise RuntimeUnusableError(f"device cuda: {line.strip()[:300]}") from error


def traced(network: Network, pixels: Tensor) -> Graph:
    """The network's graph, traced on `pixels`, (1, H, W, 3) uint8, with its weights as constants.

    Traced as a function, not as a module: the result equals a frozen module's and takes an eighth of the
    time, as the network is not described to the compiler.
    """

    def trace() -> Graph:
        jit_trace: Any = torch.jit.trace
        with torch.no_grad():
            graph: Graph = jit_trace(lambda image_bgr: network(image_bgr), pixels, check_trace=False)
        return graph

    with warnings.catch_warnings(), ThreadPoolExecutor(1) as thread:
        # The tracer warns of sizes that become constants, rightly or not; the graph is checked instead.
        warnings.simplefilter("ignore")
        # For each operation the tracer reads the whole stack of calls; a thread's own is short.
        return thread.submit(trace).result()


class TorchScriptRuntime:
    """See `base.Runtime`. Computes in float32, the precision of the file."""

    product: Product = staticmethod(torch_product)
    name: RuntimeName = "torch"

    def __init__(
        self,
        path: Path,
        head: Head | None = None,
        *,
        precision: Precision = "auto",
        threads: int | None = None,
    ) -> None:
        if precision not in ("auto", "float32"):
            raise RuntimeUnusableError(f"{path}: a TorchScript file computes in float32, not in {precision}")
        if threads is not None:
            torch.set_num_threads(threads)
        self._module = load_torchscript(path)
        self.head = head if head is not None else own_facts(torchscript_facts(path), path).head()
        self.precision, self.precision_reason = "float32", "precision of the file"

    @property
    def threads(self) -> int:
        return torch.get_num_threads()

    def prepare(self, height: int, width: int) -> None:
        for _ in range(2):
            self.infer(np.zeros((height, width, 3), np.uint8))

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        with torch.inference_mode():
            outputs = [level[0].numpy() for level in self._module(torch.from_numpy(image_bgr).unsqueeze(0))]
        return self.head.levels(outputs)


def load_torchscript(path: Path) -> Any:
    """The module in a TorchScript file, frozen. It is a program: its code runs."""
    if not path.is_file():
        raise RuntimeUnusableError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            # torch deprecates this file format; existing files must still be readable.
            warnings.simplefilter("ignore", DeprecationWarning)
            load: Any = torch.jit.load
            return torch.jit.freeze(load(str(path), map_location="cpu").eval())
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:300]
        if "torchvision::nms" in reason:
            reason = "it calls torchvision's NMS; export it without nms=True"
        raise RuntimeUnusableError(f"{path}: torch cannot load it: {reason}") from error


def torchscript_facts(path: Path) -> ExportedFacts | ForeignFacts:
    """Read the metadata of a TorchScript file, our own or Ultralytics'; nothing in it is run.

    The file does not have the shapes of its outputs: Ultralytics' are tried when it is started.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.partition("/")[2]: name for name in archive.namelist()}
            key = next((key for key in (f"extra/{KEY}", "extra/config.txt") if key in names), None)
            if key is None:
                raise not_ours(path)
            if archive.getinfo(names[key]).file_size > _LARGEST_METADATA_BYTES:
                raise RuntimeUnusableError(
                    f"{path}: its metadata has more than {_LARGEST_METADATA_BYTES} bytes"
                )
            text = archive.read(names[key]).decode(errors="replace")
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise RuntimeUnusableError(f"{path}: is not a TorchScript file ({error})") from error
    if key.endswith(KEY):
        return ExportedFacts.from_json(text, path)
    try:
        stated = json.loads(text)
    except (ValueError, RecursionError):
        stated = None
    if not isinstance(stated, dict):
        raise RuntimeUnusableError(f"{path}: its metadata (extra/config.txt) is not a table in JSON")
    return recognise_by_metadata(path, stated)
