"""Loads a model file in a process of its own first: a few hundred bytes may ask for gigabytes, or never end.

Nothing in the file says what loading takes: constants are computed, functions are expanded in each other, and
a checkpoint's pickle makes values of values. TorchScript is not tried, it is a program.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from vision.file_kinds import open_file
from vision.runtimes.base import RuntimeName, RuntimeUnusableError, required, version
from vision.runtimes.stored_choice import cache_folder
from vision.weights import DEFAULT_EXPORT

LOAD_S = 60.0
"""A network of 270 MB takes 4 s on two cores."""
MEMORY_BYTES, MEMORY_PER_BYTE = 1 << 30, 8
"""What loading may take beside the runtime itself, and for each byte of the file."""
CHECKPOINT_S = 10
"""Processor time of reading a checkpoint; one of 119 MB takes 0.5 s."""
CHECKPOINT_BYTES, CHECKPOINT_PER_BYTE = 32 << 20, 2
"""As above, of reading a checkpoint: 1.1 times a large file."""
_TOO_LARGE = 3  # exit code
_ERRORS_ONLY = 3


def check_load(path: Path, runtime: RuntimeName) -> None:
    """Check that a file is loaded within the limits; what else is wrong with it is for the caller to find.

    With torch the file is a checkpoint, and only read.

    A file that was is not tried again. The bundled model is trusted as the code beside it.

    Raises:
        RuntimeUnusableError: it takes too long or too much memory, or ends the process.
    """
    if path == DEFAULT_EXPORT:
        return
    try:
        marker = cache_folder() / f"{runtime}-{_digest(path, runtime)}.loads"
        if marker.exists():
            return
        done = _run(runtime, path)
    except subprocess.TimeoutExpired:
        raise _harmful(path, f"{runtime} has not loaded it within {LOAD_S:g} s") from None
    except OSError as error:
        raise RuntimeUnusableError(f"{path}: cannot be read: {error.strerror or error}") from error
    if done.returncode == -signal.SIGXCPU:
        raise _harmful(path, f"{runtime} needs more than {CHECKPOINT_S} s of processor time to read it")
    if done.returncode == _TOO_LARGE:
        raise _harmful(path, f"{runtime} needs more than {_allowed(path, runtime) >> 20} MiB to load it")
    if done.returncode != 0:
        last = (done.stderr.decode(errors="replace").strip().splitlines() or ["no output"])[-1]
        raise RuntimeUnusableError(
            f"{path}: {runtime} ends with code {done.returncode} when it loads it: {last[:200]}"
        )
    with contextlib.suppress(OSError):  # it is tried again next time
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()


def _run(runtime: RuntimeName, path: Path) -> subprocess.CompletedProcess[bytes]:
    """Run `main` in a process of its own."""
    command = [sys.executable, "-m", "vision.runtimes.load_trial", runtime, str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.run(command, capture_output=True, timeout=LOAD_S, check=False, env=environment)


def _harmful(path: Path, reason: str) -> RuntimeUnusableError:
    return RuntimeUnusableError(
        f"{path}: {reason}: it is damaged or made to harm; export it, or download it, again"
    )


def _files(path: Path) -> list[Path]:
    """Return the files of a model: OpenVINO's numbers are beside its `.xml`."""
    beside = path.with_suffix(".bin")
    return [path, beside] if path.suffix == ".xml" and beside.is_file() else [path]


def _digest(path: Path, runtime: RuntimeName) -> str:
    """Return what identifies the file and the runtime that loads it."""
    digest = hashlib.sha256()
    for each in _files(path):
        with open_file(each) as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    digest.update(version(runtime).encode())
    return digest.hexdigest()[:32]


def _allowed(path: Path, runtime: str) -> int:
    size = sum(each.stat().st_size for each in _files(path))
    if runtime == "torch":
        return CHECKPOINT_BYTES + CHECKPOINT_PER_BYTE * size
    return MEMORY_BYTES + MEMORY_PER_BYTE * size


def _limit(more_bytes: int, more_s: int | None) -> None:
    """Limit address space and processor time to those in use and some more; where the system cannot, not."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + more_bytes
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        if more_s is not None:
            seconds = int(time.process_time()) + more_s
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]))


# Each imports its runtime, and returns what loads the file. One thread: each reserves address space.


def _onnxruntime(path: str) -> Callable[[], object]:
    onnxruntime = required("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS_ONLY
    options.intra_op_num_threads = 1
    return lambda: onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def _openvino(path: str) -> Callable[[], object]:
    core = required("openvino").Core()
    return lambda: core.compile_model(core.read_model(path), "CPU", {"INFERENCE_NUM_THREADS": 1})


def _torch(path: str) -> Callable[[], object]:
    from vision.yolo.torch_archive import load_archive

    return lambda: load_archive(path)


_LOADERS: dict[str, Callable[[str], Callable[[], object]]] = {
    "onnxruntime": _onnxruntime,
    "openvino": _openvino,
    "torch": _torch,
}


def main(runtime: str, path: str) -> int:
    """Load the file; returns the exit code."""
    load = _LOADERS[runtime](path)
    _limit(_allowed(Path(path), runtime), CHECKPOINT_S if runtime == "torch" else None)
    try:
        load()
    except MemoryError:
        return _TOO_LARGE
    except Exception as error:
        text = str(error).lower()
        return _TOO_LARGE if "alloc" in text or "memory" in text else 0
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
