"""The how-to runs for someone who has only installed the package: no book, no notebook tools."""

import os
import subprocess
import sys
from pathlib import Path

import nbformat
import yaml

ROOT = Path(__file__).resolve().parents[2]
NAME = "your_own_domains"


def test_how_to_runs_with_the_installed_package_alone(tmp_path):
    target, elsewhere = tmp_path / "installed", tmp_path / "elsewhere"
    elsewhere.mkdir()
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", target]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, ROOT], check=True)
    notebook = nbformat.read(ROOT / "notebooks" / f"{NAME}.ipynb", as_version=4)
    sources = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    small = yaml.safe_load((ROOT / "notebooks" / "profiles" / "smoke.yml").read_text())[NAME]
    parameters = "\n".join(f"{name} = {value}" for name, value in small.items())
    first, *others = sources  # the parameters, then what they are replaced by
    script = elsewhere / "how_to.py"
    alone = "import sys\nsys.modules['experiments'] = None  # the book's package is not there"
    light = (
        "import ipo.own_domains\n"
        "heavy = {'pandas', 'scipy', 'mujoco', 'minigrid', 'matplotlib'} & sys.modules.keys()\n"
        "assert not heavy, f'importing the package imports {heavy}'"
    )
    script.write_text("\n\n".join([alone, light, "In = []", first, parameters, *others]))
    where = "\nimport ipo\nprint('installed in', ipo.__file__)\n"
    script.write_text(script.read_text() + where)
    done = subprocess.run(
        [sys.executable, script],
        cwd=elsewhere,
        env=os.environ | {"PYTHONPATH": str(target), "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert f"installed in {target}" in done.stdout
    assert "has action space" in done.stdout
