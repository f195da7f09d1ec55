"""A container that boots the systemd of Debian, without a network, with the wheel below /opt/companion.

What takes minutes is kept in the folder of COMPANION_TEST_SYSTEMD: Debian's files, from the archive that this
machine's apt uses, and the packages of a plain installation, from pip's index.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from mavlink_sim.testing import QUICK_FLIGHT
from tests.programs import SYSTEMD

ROOT = Path(__file__).parents[2]
SUITE, PYTHON = "bookworm", "3.11"
DEBIAN = ("systemd", "systemd-sysv", "dbus", "libpam-systemd", "udev", "procps", "python3", "python3-venv")
VERSIONS = ("1.0", "1.1")
"""Folders in /opt/companion: the same wheel twice, as an old and a new version."""
OLD, NEW = (f"/opt/companion/{version}" for version in VERSIONS)
TRUTH = Path("var/tmp/truth.jsonl")
SETTINGS_FILE = "/etc/companion/companion.toml"
SETTINGS = """\
[vehicle]
url = "udpin://127.0.0.1:14540"

[source]
uri = "none"
"""
_SHARED = "/srv/packages"
# It ends when the clock is set, from a network that is not there. The real one is not started in containers.
TIME_WAIT = """\
[Unit]
DefaultDependencies=no
Before=time-sync.target
Wants=time-sync.target

[Service]
Type=oneshot
ExecStart=/usr/bin/sleep infinity
TimeoutStartSec=infinity

[Install]
WantedBy=sysinit.target
"""
NSPAWN = (
    "systemd-nspawn",
    "--quiet",
    "--register=no",
    "--keep-unit",
    "--capability=all",
    "--private-network",
)
_BOOT_S = 90.0
_CLEAN = ("env", "-i", "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin", "HOME=/root", "LANG=C.UTF-8")


def run(command: Sequence[str | Path], timeout_s: float = 600.0) -> str:
    """Run a program here and return its output. Raises RuntimeError with it."""
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{command}: {done.stdout}{done.stderr}")
    return done.stdout


def debian() -> Path:
    """Return the folder with Debian's files."""
    archives = run(
        ("apt-get", "indextargets", "--format", "$(SITE) $(LABEL) $(COMPONENT)", "Created-By: Packages")
    )
    archive = next(line.split()[0] for line in archives.splitlines() if line.endswith(" Debian main"))
    include = ",".join(DEBIAN)
    return _kept(
        f"{SUITE} {include}",
        lambda folder: run(
            ("debootstrap", "--variant=minbase", f"--include={include}", SUITE, folder, archive), 1800.0
        ),
    )


def packages(system: Path) -> Path:
    """Return the folder with the packages of a plain installation, compiled by the container's Python."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = project["dependencies"]
    constraints = ROOT / "constraints.txt"

    def fetch(folder: Path) -> None:
        target = ("--target", folder, "--python-version", PYTHON, "--implementation", "cp")
        options = ("--quiet", "--no-compile", "--only-binary=:all:", "--constraint", constraints)
        run((sys.executable, "-m", "pip", "install", *target, *options, *wanted), 1800.0)
        run(
            (
                *(*NSPAWN, "--pipe", f"--directory={system}", f"--bind={folder}:{_SHARED}"),
                *("python3", "-m", "compileall", "-q", "-j2", _SHARED),
            ),
            1800.0,
        )

    return _kept(f"{wanted} {constraints.read_text()}", fetch)


def _kept(recipe: str, make: Callable[[Path], object]) -> Path:
    """Return a folder of the cache, which is made whole or not at all."""
    assert SYSTEMD is not None
    folder = SYSTEMD / hashlib.sha256(recipe.encode()).hexdigest()[:16]
    if not folder.is_dir():
        part = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        make(part)
        part.rename(folder)
    return folder


def install_wheel(system: Path, wheel: Path, changes: Path) -> None:
    """Make the two virtual environments on top of Debian's files, without starting systemd."""
    with mounted((system,), changes) as root:
        shared = (f"--bind-ro={wheel.parent}:/srv/wheels", "--pipe", f"--directory={root}")
        script = [f"python3 -m venv {OLD}", f"python3 -m venv --without-pip {NEW}"]
        for each in (OLD, NEW):
            pip = f"{OLD}/bin/pip --python {each}/bin/python install -q --no-index --no-deps"
            script.append(f"{pip} /srv/wheels/{wheel.name}")
            script.append(f"echo {_SHARED} > {each}/lib/python{PYTHON}/site-packages/shared.pth")
        run((*NSPAWN, *shared, "sh", "-ec", "\n".join(script)))


@contextmanager
def mounted(lower: Sequence[Path], changes: Path) -> Iterator[Path]:
    """Mount folders above each other, the last lowest; what is written goes to `changes/upper`."""
    upper, work, root = (changes / name for name in ("upper", "work", "root"))
    for folder in (upper, work, root):
        folder.mkdir(parents=True, exist_ok=True)
    layers = ":".join(map(str, lower))
    run(
        (
            "mount",
            "-t",
            "overlay",
            "-o",
            f"lowerdir={layers},upperdir={upper},workdir={work}",
            "overlay",
            root,
        )
    )
    try:
        yield root
    finally:
        run(("umount", "--lazy", root))


class Container:
    """A container that runs.

    Attributes:
        root: its files, as this machine sees them.
    """

    def __init__(self, root: Path, shared: Path) -> None:
        self.root = root
        self._command = (
            *(*NSPAWN, "--boot", "--console=pipe", f"--directory={root}"),
            *(f"--machine=test-{root.parent.name}-{os.getpid()}", f"--bind-ro={shared}:{_SHARED}"),
        )
        self._process: subprocess.Popen[bytes] | None = None
        self._leader = 0

    def boot(self) -> float:
        """Boot, and return the time until multi-user.target, seconds."""
        began_s = time.monotonic()
        with (self.root.parent / "console.log").open("ab") as console:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=console, stderr=subprocess.STDOUT
            )
        wait_for(lambda: self._first_process() is not None, "a first process", _BOOT_S)
        self._leader = self._first_process() or 0
        wait_for(
            lambda: self.run("systemctl", "is-active", "multi-user.target", check=False) == "active\n",
            "multi-user.target",
            _BOOT_S,
        )
        return time.monotonic() - began_s

    def _first_process(self) -> int | None:
        """Return the process that is the first one inside."""
        assert self._process is not None
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        for each in children:  # at first it is a process of nspawn
            with suppress(OSError):
                if Path(f"/proc/{each}/comm").read_text() == "systemd\n":
                    return int(each)
        return None

    def power_off(self) -> None:
        """Shut down, and wait for the end."""
        if self._process is not None:
            self._process.terminate()  # nspawn asks systemd to power off
            try:
                self._process.wait(90)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
                raise
            finally:
                self._process = None

    def start(self, *command: str) -> subprocess.Popen[str]:
        """Start a program inside, as root; its output is one pipe."""
        inside = ("nsenter", f"--target={self._leader}", "--all", "--wd=/", *_CLEAN, *command)
        return subprocess.Popen(
            inside, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def run(self, *command: str, check: bool = True, timeout_s: float = 240.0) -> str:
        """Run a program inside, as root, and return its output."""
        code, output = self.result(*command, timeout_s=timeout_s)
        assert code == 0 or not check, f"{' '.join(command)}: exit code {code}\n{output}"
        return output

    def result(self, *command: str, timeout_s: float = 240.0) -> tuple[int, str]:
        """The same, with its exit code."""
        process = self.start(*command)
        try:
            output, _ = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        return process.returncode, output

    def companion(self, *words: str, environment: str = "/opt/companion/current") -> str:
        """Run `companion` inside."""
        return self.run(f"{environment}/bin/companion", *words)

    def show(self, name: str, unit: str = "companion") -> str:
        """Return a property of a unit."""
        return self.run("systemctl", "show", unit, f"--property={name}", "--value").strip()

    def write(self, path: str, text: str) -> None:
        """Write a file, from outside."""
        file = self.root / path.lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)


@contextmanager
def running(lower: Sequence[Path], changes: Path, shared: Path) -> Iterator[Container]:
    """Boot a container beside a unit that waits for the time without end."""
    with mounted(lower, changes) as root:
        container = Container(root, shared)
        name = "systemd-time-wait-sync.service"
        container.write(f"/etc/systemd/system/{name}", TIME_WAIT)
        wants = root / "etc/systemd/system/sysinit.target.wants"
        wants.mkdir(parents=True, exist_ok=True)
        (wants / name).symlink_to(f"/etc/systemd/system/{name}")
        try:
            container.boot()
            yield container
        except BaseException as error:
            log = (changes / "console.log").read_text(errors="replace").splitlines()[-20:]
            error.add_note("\n".join(["last lines of the console:", *log]))
            raise
        finally:
            container.power_off()


def wait_for(condition: Callable[[], object], what: str, within_s: float) -> None:
    """Wait until a function returns something true. Raises TimeoutError."""
    deadline_s = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"not there: {what}")
        time.sleep(0.02)


def start_simulator(container: Container) -> None:
    """Start a new simulated vehicle inside, and wait until it runs; it writes `TRUTH`."""
    container.run("systemctl", "stop", "simulator", check=False)
    (container.root / TRUTH).unlink(missing_ok=True)
    values = [word for name, value in QUICK_FLIGHT.items() for word in ("--param", f"{name}={value:g}")]
    simulator = (f"{OLD}/bin/mavlink-sim", "--no-console", "--ready-after", "0", "--truth", f"/{TRUTH}")
    container.run("systemd-run", "--unit=simulator", "--collect", *simulator, *values)
    wait_for((container.root / TRUTH).is_file, "a simulated vehicle", 30.0)
