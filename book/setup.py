"""Set-up: the environment in .venv, and with --system the system packages that the tests use.

Runs before anything is installed, so it uses the standard library only.
"""

import sys

if sys.version_info < (3, 11):  # noqa: UP036  (before the imports that an old Python lacks)
    sys.exit(
        "The book needs Python 3.11 or newer, and {} is {}.{}. "
        "Name another one, for example: make book PYTHON=python3.12".format(
            sys.executable, *sys.version_info[:2]
        )
    )

import hashlib
import importlib.util
import os
import shutil
import subprocess
from ctypes.util import find_library
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
STAMP = VENV / "installed"


def draws_without_display():
    """Whether OpenGL is there together with a driver."""
    return find_library("EGL") and any(find_library(f"EGL_{name}") for name in ("mesa", "nvidia"))


# Debian's packages, whether what they bring is there, and what is lost without them.
SYSTEM_PACKAGES = (
    (
        ["chromium"],
        lambda: shutil.which("chromium"),
        "the tests of the built site in a browser are skipped",
    ),
    (
        ["libegl1", "libgl1", "libgl1-mesa-dri", "libegl-mesa0"],
        draws_without_display,
        "doors are simulated, but not drawn",
    ),
)


def install_environment():
    """Create .venv and install every pinned package; instant when nothing has changed."""
    wanted = environment_key()
    if STAMP.exists() and STAMP.read_text() == wanted:
        return
    if importlib.util.find_spec("ensurepip") is None:  # Debian ships venv in a package of its own
        apt_install(["python3-venv"], "no environment can be created")
    print("Installing the environment into .venv (once; one or two minutes)", flush=True)
    run(sys.executable, "-m", "venv", VENV)
    pip = [VENV / "bin" / "python", "-m", "pip", "--disable-pip-version-check", "install", "-qq"]
    run(*pip, "--requirement", ROOT / "environment.txt")
    for package in (ROOT, ROOT / "notebooks"):  # ipo, and the experiments
        run(*pip, "--no-deps", "--no-build-isolation", "--editable", package)
    STAMP.write_text(wanted)


def environment_key():
    """Hash of all that the environment depends on; a moved folder needs new absolute paths."""
    key = hashlib.sha256(f"{sys.version} {ROOT}".encode())
    for name in ("environment.txt", "pyproject.toml", "notebooks/pyproject.toml"):
        key.update((ROOT / name).read_bytes())
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
    status = subprocess.run(command).returncode
    if status:
        sys.exit("Set-up failed: {}".format(" ".join(map(str, command))))


if __name__ == "__main__":
    install_environment()
    if "--system" in sys.argv[1:]:
        install_system_packages()
