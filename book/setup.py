"""Set-up: the environment in .venv, and with --system the system packages that the tests use.

Runs before anything is installed, so it uses the standard library only.
"""

import sys

if sys.version_info < (3, 11, 5):
    sys.exit(
        "The book needs Python 3.11.5 or newer, and {} is {}.{}.{}. "
        "Name another one, for example: make book PYTHON=python3.12".format(
            sys.executable, *sys.version_info[:3]
        )
    )

import contextlib
import fcntl
import hashlib
import importlib.util
import os
import re
import shutil
import signal
import subprocess
from ctypes.util import find_library
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
STAMP = VENV / "installed"
LOCKS = ROOT / "book" / "locks"  # every pinned package with its hashes
PYTHON = VENV / "bin" / "python"
PIP = [PYTHON, "-m", "pip", "--disable-pip-version-check"]


def draws_without_display():
    """Whether OpenGL is there together with a driver."""
    return find_library("EGL") and any(find_library(f"EGL_{name}") for name in ("mesa", "nvidia"))


# Debian's packages, whether what they bring is there, and what is lost without them.
SYSTEM_PACKAGES = (
    (
        ["chromium"],
        lambda: shutil.which("chromium"),
        "the book has no PDF, and the tests of the site in a browser are skipped",
    ),
    (
        ["libegl1", "libgl1", "libgl1-mesa-dri", "libegl-mesa0"],
        draws_without_display,
        "doors are simulated, but not drawn",
    ),
)


def install_environment():
    """Create .venv and install every pinned package; instant when nothing has changed."""
    if is_installed():
        return
    if not os.access(ROOT, os.W_OK):
        sys.exit(
            f"Set-up creates {VENV}, and its folder cannot be written. "
            "Copy the project to one that can."
        )
    with alone():
        if not is_installed():  # by the set-up that was waited for
            install()


def is_installed():
    return STAMP.exists() and STAMP.read_text() == environment_key()


@contextlib.contextmanager
def alone():
    """One set-up at a time: the folder is locked, also by what `run` starts and a kill leaves."""
    folder = os.open(ROOT, os.O_RDONLY)
    os.set_inheritable(folder, True)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print(f"Waiting for the set-up that fills {VENV} now", flush=True)
        fcntl.flock(folder, fcntl.LOCK_EX)
    yield
    os.close(folder)


def install():
    """Everything anew: a set-up that was killed may have left half a package."""
    STAMP.unlink(missing_ok=True)
    if importlib.util.find_spec("ensurepip") is None:  # Debian ships venv in a package of its own
        apt_install(["python3-venv"], "no environment can be created")
    print("Installing the environment into .venv (once; about a minute)", flush=True)
    run(sys.executable, "-m", "venv", "--clear", VENV)
    pip_install(*locked("uv.txt"))
    if not uv_install(*locked("packages.txt")):
        pip_install(*locked("packages.txt"))
    install_torch()
    own = [option for folder in (ROOT, ROOT / "notebooks") for option in ("--editable", folder)]
    pip_install("--no-deps", "--no-build-isolation", *own)  # ipo, and the experiments
    STAMP.write_text(environment_key())


def locked(name):
    """Options to install what a file pins, and nothing whose hash it does not have."""
    return ["--no-deps", "--require-hashes", "--requirement", LOCKS / name]


def pip_install(*options):
    run(*PIP, "install", "-qq", "--no-compile", *options)


def uv_install(*options):
    """Whether uv could: it is much faster than pip, but has a configuration of its own."""
    listing = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True).stdout
    index = re.search(r"\.index-url='(.+)'", listing)
    settings = [f"UV_DEFAULT_INDEX={index[1]}"] if index else []
    return succeeds(
        "env", *settings, VENV / "bin" / "uv", "pip", "install", "--python", PYTHON, *options
    )


def install_torch():
    """The CPU build, where the registries that pip is configured with have it, or the plain one."""
    if succeeds(*PIP, "install", "--no-compile", *locked("torch-cpu.txt")):
        print("torch: the CPU build", flush=True)
        return
    print(
        "torch: the registries that pip is configured with do not have the CPU build that is "
        "pinned, so the plain one is taken, which on Linux brings CUDA (6 GB).\n"
        "To have the CPU build, name PyTorch's own index for it in PIP_EXTRA_INDEX_URL, remove "
        ".venv and repeat.",
        flush=True,
    )
    pip_install(*locked("torch.txt"))


def environment_key():
    """Hash of all that the environment depends on; a moved folder needs new absolute paths."""
    key = hashlib.sha256(f"{sys.version} {ROOT}".encode())
    projects = [ROOT / "pyproject.toml", ROOT / "notebooks" / "pyproject.toml"]
    for path in [*sorted(LOCKS.iterdir()), *projects]:
        key.update(path.read_bytes())
    return key.hexdigest()


def install_system_packages():
    """Install what is missing where that is allowed; otherwise say what to type. Never fails."""
    for packages, is_there, loss in SYSTEM_PACKAGES:
        if not is_there():
            apt_install(packages, loss)


def apt_install(packages, loss):
    """Install Debian packages, or print the command and what is missing without it."""
    install = ["apt-get", "install", "--yes", "--no-install-recommends", *packages]
    prefix = [] if os.geteuid() == 0 else ["sudo", "-n"]
    allowed = not prefix or succeeds("sudo", "-n", "true")
    if shutil.which("apt-get") and allowed:
        print("Installing {}".format(" ".join(packages)), flush=True)
        environment = ["env", "DEBIAN_FRONTEND=noninteractive"]
        if succeeds(*prefix, "apt-get", "update") and succeeds(*prefix, *environment, *install):
            return
    print(
        "Missing: {}. Without it, {}.\nTo install it: sudo apt-get update && sudo {}".format(
            " ".join(packages), loss, " ".join(install)
        ),
        flush=True,
    )


def succeeds(*command):
    """Whether a command exists and ends well; its output is not shown."""
    return (
        shutil.which(command[0]) is not None
        and subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True).returncode == 0
    )


def run(*command):
    """Run a command; end the set-up with its exit status if it fails."""
    status = subprocess.run(command, close_fds=False).returncode
    if status:
        sys.exit("Set-up failed: {}".format(" ".join(map(str, command))))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C, it ends pip, too
    try:
        install_environment()
        if "--system" in sys.argv[1:]:
            install_system_packages()
    except KeyboardInterrupt:
        sys.exit("Set-up was interrupted; the next one begins anew")
