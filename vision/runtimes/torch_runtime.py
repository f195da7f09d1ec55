"""The default runtime: torch on the processor, the network as a traced graph with its weights inside."""

from __future__ import annotations

import collections
import copy
import logging
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vision.runtimes import base
from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError
from vision.runtimes.network import Network
from vision.yolo.architecture import YoloModel
from vision.yolo.level_outputs import Head, LevelOutput, Product

logger = logging.getLogger(__name__)

Graph = Callable[[Tensor], tuple[Tensor, ...]]
_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
# Where a graph is good for one size alone. A camera has one; a folder of photographs has a few.
_MOST_GRAPHS = 4
# What the tracer is shown, and what its graph is then tried on; in strides, high and wide.
_TRACED, _TRIED = (2, 4), (4, 6)
# Enough to tell two precisions apart, little enough not to delay the start: as many pairs of runs as fit.
_TRIAL_PAIRS = range(3, 20)
_TRIAL_S = 0.1
_TRIAL_SIDE = 320
# What bfloat16 loses must buy something; and what is nearly as fast in both is to choose the same each time.
_WORTH = 0.8


def torch_product(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """`a @ b` with torch's threads: numpy's own pool would spin beside them."""
    with torch.inference_mode():
        product: NDArray[np.float32] = (torch.from_numpy(a) @ torch.from_numpy(b)).numpy()
    return product


class TorchRuntime:
    """A model on torch. See `contract.Runtime`.

    Args:
        model: is taken over and changed.
        class_ids: sorted; the only classes to compute. None: all.
        precision: `auto` takes bfloat16 only where the processor computes in it, in a fifth less time.
        threads: processor threads, of the whole process's torch; None leaves them as they are.
        sparse_boxes: see `Network`.
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
    ) -> None:
        if precision not in ("auto", *_DTYPES):
            raise RuntimeUnusableError(
                f"torch computes in float32 or bfloat16 on the processor, not {precision}"
            )
        if threads is not None:
            torch.set_num_threads(threads)
        self._network = Network(model, class_ids, sparse_boxes=sparse_boxes).channels_last()
        self.head: Head = self._network.head
        self.precision, self.precision_reason = self._choose_precision(precision)
        self._network.in_precision(_DTYPES[self.precision])
        self._graphs: collections.OrderedDict[tuple[int, int], Graph] = collections.OrderedDict()
        self._graph = self._any_size()

    @property
    def threads(self) -> int:
        return torch.get_num_threads()

    def prepare(self, height: int, width: int) -> None:
        # The graph's first runs settle its memory; later ones only compute.
        blank = np.zeros((height, width, 3), np.uint8)
        for _ in range(2):
            self.infer(blank)

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        pixels = torch.from_numpy(image_bgr).unsqueeze(0)
        with torch.inference_mode():
            graph = self._graph or self._graph_of_size(pixels)
            maps = [level[0].numpy() for level in graph(pixels)]
        return self.head.levels(maps)

    def _any_size(self) -> Graph | None:
        """One graph for inputs of every size; None if the tracer took a size for a constant."""
        stride = max(self.head.strides)
        # Noise, so that maps that were taken apart and joined wrongly are not the same by chance.
        noise = torch.Generator().manual_seed(0)
        shown, tried = (
            torch.randint(256, (1, high * stride, wide * stride, 3), generator=noise, dtype=torch.uint8)
            for high, wide in (_TRACED, _TRIED)
        )
        graph = traced(self._network, shown)
        with torch.inference_mode():
            expected = self._network(tried)
            try:
                found = graph(tried)
            except RuntimeError as error:
                logger.debug("the graph is good for one size of input alone: %s", error)
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

    def _choose_precision(self, asked: Precision) -> tuple[str, str]:
        native = base.bfloat16_instructions()
        if asked == "bfloat16" and not native:
            logger.warning("this processor does not compute in bfloat16; it is emulated, and slow")
        if asked != "auto":
            return asked, "as asked"
        if not native:
            return "float32", "this processor does not compute in bfloat16"
        full, half = self._measured_ms(torch.float32, torch.bfloat16)
        chosen = "bfloat16" if half < _WORTH * full else "float32"
        return chosen, f"measured {full:.1f} ms in float32, {half:.1f} ms in bfloat16 ({native})"

    def _measured_ms(self, *dtypes: torch.dtype) -> list[float]:
        """The shortest of some inferences of a small input in each, by turns: other work slows down both."""
        pixels = torch.zeros(1, _TRIAL_SIDE, _TRIAL_SIDE, 3, dtype=torch.uint8)
        with torch.inference_mode():
            graphs = [traced(copy.deepcopy(self._network).in_precision(dtype), pixels) for dtype in dtypes]
            for graph in graphs * 2:
                graph(pixels)  # its first runs settle its memory
            times: list[list[float]] = [[] for _ in dtypes]
            since = time.perf_counter()
            for count in range(_TRIAL_PAIRS.stop):
                if count >= _TRIAL_PAIRS.start and time.perf_counter() - since > _TRIAL_S:
                    break
                for graph, spent in zip(graphs, times, strict=True):
                    started = time.perf_counter()
                    graph(pixels)
                    spent.append((time.perf_counter() - started) * 1e3)
        return [min(spent) for spent in times]


def traced(network: Network, pixels: Tensor) -> Graph:
    """The network's graph, traced on `pixels`, (1, H, W, 3) uint8, with its weights as constants.

    Traced as a function, not as a module: the result is the same as a frozen module's and is made in an
    eighth of the time, as no part of the network has to be described to the compiler.
    """
    with torch.no_grad(), warnings.catch_warnings():
        # The tracer warns of sizes that become constants, right or wrong; the graph is tried instead.
        warnings.simplefilter("ignore")
        trace: Any = torch.jit.trace
        graph: Graph = trace(lambda image_bgr: network(image_bgr), pixels, check_trace=False)
        return graph
