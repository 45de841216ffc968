"""The build, on a toy project of two notebooks: what it executes, refuses, keeps and hides."""

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import nbformat
import pytest
import setup
from toy_book import CELLS, in_toy, write_notebook, write_toy

import build
import execute
import website
from build import main
from chapters import tree_hash
from messages import BuildError
from profiles import load_notebooks

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def built_toy(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("built") / "toy"
    write_toy(root)
    with pytest.MonkeyPatch.context() as patch:
        in_toy(patch, root)
        assert main([], root) == 0
    return root


@pytest.fixture
def toy(built_toy, tmp_path, monkeypatch) -> Path:
    """A copy of the built toy project, to be changed."""
    root = tmp_path / "toy"
    shutil.copytree(built_toy, root)
    in_toy(monkeypatch, root)
    return root


def executed(root: Path, name: str) -> Path:
    return root / "book" / "_executed" / "class" / name


def outdated(root: Path) -> set[str]:
    notebooks = load_notebooks(root, "class", executed(root, ""))
    return {notebook.name for notebook in notebooks if not notebook.is_current()}


# ------------------------------------------------------------------------- what is executed


def test_second_build_does_nothing(toy, capsys):
    before = tree_hash(toy / "book")
    assert main([], toy) == 0
    assert capsys.readouterr().out.count("unchanged") == 3  # two notebooks and the site
    assert tree_hash(toy / "book") == before


def test_figures_do_not_depend_on_how_the_user_draws(toy, tmp_path, monkeypatch):
    (tmp_path / "matplotlibrc").write_text("font.size: 99\n")
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path))
    cell = "import matplotlib\nprint(matplotlib.rcParams['font.size'])"
    write_notebook(toy, "plain", [CELLS["plain"][0], (cell, "")])
    assert main(["--chapter", "plain"], toy) == 0
    assert "10.0" in executed(toy, "plain.ipynb").read_text()


@pytest.mark.parametrize(
    ("path", "text", "expected"),
    [
        ("environment.txt", "numpy==3\n", {"plain", "painted"}),
        ("data/paper/table.csv", "2\n", {"plain", "painted"}),
        ("data/results/plain/rows.csv", "2\n", {"plain", "painted"}),
        ("data/results/plain/more.csv", "2\n", {"plain", "painted"}),
        ("notebooks/profiles/class.yml", "plain: {num_runs: 4}\n", {"plain"}),
        ("ipo/colors.py", 'from ipo import shades\n\nRED = "red"\n', {"painted"}),
        ("ipo/shades.py", 'DARK = "light"\n', {"painted"}),
        ("ipo/shades.py", '"""Shades."""\n\nDARK = "dark"  # a comment\n', set()),
        ("book/intro.md", "# Another toy\n", set()),
    ],
)
def test_only_what_depends_on_a_change_is_outdated(toy, path, text, expected):
    assert outdated(toy) == set()
    (toy / path).write_text(text)
    assert outdated(toy) == expected


def test_changed_code_executes_its_notebook_only(toy, capsys):
    other = executed(toy, "plain.ipynb").read_bytes()
    write_notebook(toy, "painted", [*CELLS["painted"], ("print('new ' * 2)", "")])
    assert main([], toy) == 0
    assert "notebooks/plain.ipynb    unchanged" in capsys.readouterr().out
    assert "new new" in executed(toy, "painted.ipynb").read_text()
    assert "new new" in (toy / "book/_build/html/painted.html").read_text()
    assert executed(toy, "plain.ipynb").read_bytes() == other


def test_changed_text_reaches_the_site_without_execution(toy, capsys):
    write_notebook(toy, "plain", CELLS["plain"], text="Better said.")
    assert main([], toy) == 0
    assert capsys.readouterr().out.count("unchanged") == 2
    page = (toy / "book/_build/html/plain.html").read_text()
    assert "Better said." in page and "3 runs" in page


def test_one_chapter_builds_no_site(toy, capsys):
    executed(toy, "painted.json").unlink()
    site = tree_hash(toy / "book/_build")
    assert main(["--chapter", "painted"], toy) == 0
    assert "plain" not in capsys.readouterr().out
    assert tree_hash(toy / "book/_build") == site


# ---------------------------------------------------------------------- what an execution leaves


def test_executing_again_gives_the_same_file(toy):
    before = executed(toy, "plain.ipynb").read_bytes()
    executed(toy, "plain.json").unlink()
    assert main(["--chapter", "plain"], toy) == 0
    assert executed(toy, "plain.ipynb").read_bytes() == before


def test_times_and_places_stay_out_of_the_executed_copy(built_toy):
    text = executed(built_toy, "plain.ipynb").read_text()
    traces = ("papermill", "_time", "iopub", str(built_toy), "ipykernel_")
    assert [trace for trace in traces if trace in text] == []
    record = json.loads(executed(built_toy, "plain.json").read_text())
    assert record["seconds"] > 0
    assert [cell["first_line"] for cell in record["cells"]][:2] == [
        "num_runs = 10",
        "import sys, warnings",
    ]
    assert sorted(path.name for path in executed(built_toy, "").iterdir()) == sorted(
        f"{name}.{kind}" for name in CELLS for kind in ("ipynb", "json")
    )


def test_injected_parameters_are_hidden_and_kept(built_toy):
    cells = nbformat.read(executed(built_toy, "plain.ipynb"), as_version=4).cells
    assert cells[2].metadata.tags == ["injected-parameters", "remove-cell"]
    assert "num_runs = 3" in cells[2].source
    assert "num_runs = 3" not in (built_toy / "book/_build/html/plain.html").read_text()


def test_progress_bars_are_dropped_and_warnings_kept(built_toy):
    cells = nbformat.read(executed(built_toy, "plain.ipynb"), as_version=4).cells
    assert [output.name for output in cells[5].outputs] == ["stdout"]
    assert "<cell>:3: UserWarning: careful" in cells[3].outputs[1].text


def test_page_of_run_times(built_toy):
    page = (built_toy / "book/_build/html/run_times.html").read_text()
    for expected in ('href="plain.html"', 'href="painted.html"', "colors</span>"):
        assert expected in page


# -------------------------------------------------------------------------------- what fails


def test_failing_notebook_ends_the_build_and_leaves_the_last_good_one(toy, capsys):
    site = tree_hash(toy / "book/_build")
    copy = executed(toy, "painted.ipynb").read_bytes()
    write_notebook(toy, "painted", [*CELLS["painted"], ("# why not\nsize / 0", "")])
    write_notebook(toy, "plain", [*CELLS["plain"], ("print('finished')", "")])
    assert main([], toy) == 1
    error = capsys.readouterr().err
    assert "painted, cell 4 failed: size / 0" in error
    assert "ZeroDivisionError: division by zero" in error
    assert "\x1b" not in error
    assert "ZeroDivisionError" in executed(toy, "painted.failed.ipynb").read_text()
    assert executed(toy, "painted.ipynb").read_bytes() == copy
    assert tree_hash(toy / "book/_build") == site
    assert "finished" in executed(toy, "plain.ipynb").read_text()

    write_notebook(toy, "painted", CELLS["painted"])
    assert main([], toy) == 0


def test_dying_kernel_names_its_cell(toy, capsys):
    cells = [("size = 1", "parameters"), ("import os\nos.kill(os.getpid(), 9)", ""), ("size", "")]
    write_notebook(toy, "painted", cells)
    assert main(["--chapter", "painted"], toy) == 1
    error = capsys.readouterr().err
    assert "painted, cell 3 failed: import os" in error
    assert "Kernel died" in error


def test_warning_of_the_site_ends_the_build_and_leaves_the_last_good_one(toy, capsys):
    pages = tree_hash(toy / "book/_build/html")
    (toy / "book/intro.md").write_text("# A toy\n\nSee {doc}`nowhere`.\n")
    assert main([], toy) == 1
    assert "nowhere" in capsys.readouterr().err
    assert tree_hash(toy / "book/_build/html") == pages
    assert main([], toy) == 1  # and it is not forgotten


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--profile", "clas"], "no profile 'clas'; the profiles are broken, class"),
        (["--profile", "../profiles/class"], "no profile '../profiles/class'; the profiles are"),
        (["--profile", "broken"], "notebooks/profiles/broken.yml, line 3: is no YAML"),
        (["--profile", "other_type"], "gives plain num_runs = 'three': must be of type int, as 10"),
        (["--profile", "other_list"], "gives plain num_runs = [3]: must be of type int, as 10"),
        (["--profile", "unknown_notebook"], "names plane, but the notebooks in _toc.yml are"),
        (["--profile", "unknown_parameter"], "gives plain the parameter num_rums"),
        (["--profile", "no_mapping"], "must map notebooks to parameters"),
        (["--profile", "no_parameters"], "must map notebooks to parameters"),
        (["--chapter", "plane"], "no chapter 'plane'; the chapters are plain, painted"),
    ],
)
def test_bad_requests_are_refused_before_any_work(toy, capsys, arguments, expected):
    before = tree_hash(toy / "book")
    assert main(arguments, toy) == 1
    assert expected in capsys.readouterr().err
    assert tree_hash(toy / "book") == before


@pytest.mark.parametrize("jobs", ["0", "-1", "two"])
def test_number_of_jobs_is_checked(toy, capsys, jobs):
    with pytest.raises(SystemExit):
        main(["--jobs", jobs], toy)
    assert "--jobs" in capsys.readouterr().err


def test_folder_that_cannot_be_written_is_named_with_the_cause(toy, capsys):
    folder = toy / "environment.txt" / "folder"
    assert main(["--output", str(folder)], toy) == 1
    error = capsys.readouterr().err
    assert "environment.txt/folder/_build cannot be written: Not a directory" in error
    assert "--output" in error


def test_a_full_disk_is_named_and_leaves_the_last_good_site(toy, capsys, monkeypatch):
    def full(*folders: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(toy / "page"))

    pages = tree_hash(toy / "book/_build/html")
    (toy / "book/intro.md").write_text("# Another toy\n\nSee [](plain.ipynb).\n")
    for step in ("stage", "run_jupyter_book", "finish"):
        with monkeypatch.context() as patch:
            patch.setattr(website, step, full)
            if step == "finish":
                patch.setattr(website, "run_jupyter_book", lambda source, output: output)
                patch.setattr(website.decks, "build", lambda *_: None)
            assert main([], toy) == 1
        assert "book: No space left on device; the last good site" in capsys.readouterr().err
        assert tree_hash(toy / "book/_build/html") == pages


def test_a_notebook_that_is_not_written_whole_is_named(toy, capsys, monkeypatch):
    worker = (
        "import json; open(json.loads(sys.argv[1])['output_path'], 'w').write('{'); sys.exit(1)"
    )
    monkeypatch.setattr(execute, "WORKER", worker)
    monkeypatch.setattr(execute, "LEAST_FREE", float("inf"))
    executed(toy, "plain.json").unlink()
    assert main(["--chapter", "plain"], toy) == 1
    assert "plain ended while it was written: No space left" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["book", "book/_build", "book/_executed"])
def test_a_link_to_a_folder_elsewhere_is_a_folder(toy, tmp_path, name):
    (toy / name).rename(tmp_path / "elsewhere")
    (toy / name).symlink_to(tmp_path / "elsewhere")
    before = tree_hash(tmp_path / "elsewhere")
    assert main([], toy) == 0
    assert (toy / name).is_symlink() and tree_hash(tmp_path / "elsewhere") == before


# ------------------------------------------------------------- two at once, and what was killed


@pytest.mark.parametrize("alone", [build.alone, setup.alone], ids=["build", "set-up"])
def test_the_second_waits_for_the_first_and_says_so(alone, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(setup, "ROOT", tmp_path)
    (tmp_path / "_build").mkdir()
    folder = [tmp_path] if alone is build.alone else []
    began = threading.Event()

    def second() -> None:
        with alone(*folder):
            began.set()

    thread = threading.Thread(target=second)
    with alone(*folder):
        thread.start()
        assert not began.wait(0.3)
    thread.join(10)
    assert began.is_set()
    assert "Waiting for " in "".join(capsys.readouterr())


def test_leftovers_of_a_killed_build_are_removed(toy):
    before = tree_hash(toy / "book")
    for path in ("plain.running.ipynb", "plain.running.log", "tmpabc.tmp", "../../_build/new/x"):
        executed(toy, path).parent.mkdir(exist_ok=True)
        executed(toy, path).write_text("half")
    assert main([], toy) == 0
    assert tree_hash(toy / "book") == before


@pytest.mark.parametrize("name", ["plain.ipynb", "plain.json"])
@pytest.mark.parametrize("place", [0.3, 0.9])
def test_damaged_copy_or_record_is_made_again(toy, name, place):
    content = bytearray(executed(toy, name).read_bytes())
    content[int(place * len(content))] ^= 1
    executed(toy, name).write_bytes(content)
    assert outdated(toy) == {"plain"}


@pytest.mark.parametrize("record", ["", "[]", "3", "{}"])
def test_record_of_another_type_counts_as_none(toy, record):
    executed(toy, "plain.json").write_text(record)
    assert outdated(toy) == {"plain"}


def test_damaged_page_is_built_again(toy, capsys, monkeypatch):
    def rebuilt(*folders: Path) -> None:
        raise BuildError("rebuilt")

    monkeypatch.setattr(website, "run_jupyter_book", rebuilt)
    assert main([], toy) == 0
    (toy / "book/_build/html/plain.html").write_text("half a page")
    assert main([], toy) == 1
    assert "rebuilt" in capsys.readouterr().err


@pytest.mark.parametrize("in_one_step", [True, False])
def test_folder_takes_the_place_of_another(tmp_path, monkeypatch, in_one_step):
    if not in_one_step:
        monkeypatch.setattr(website, "exchanged", lambda one, other: False)
    for content in ("old", "new"):
        (tmp_path / "made" / "_build").mkdir(parents=True, exist_ok=True)
        (tmp_path / "made" / "_build" / "page").write_text(content)
        website.replace_folder(tmp_path / "site", tmp_path / "made" / "_build")
        assert (tmp_path / "site" / "page").read_text() == content
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made", "site"]


# -------------------------------------------------------------------------------- set-up


def test_failed_set_up_leaves_no_stamp(tmp_path, monkeypatch):
    def fail(*command) -> None:
        sys.exit("failed")

    monkeypatch.setattr(setup, "STAMP", tmp_path / "installed")
    monkeypatch.setattr(setup, "run", fail)
    setup.STAMP.write_text("of other pins")
    with pytest.raises(SystemExit, match="failed"):
        setup.install_environment()
    assert not setup.STAMP.exists()


def test_set_up_of_a_folder_that_cannot_be_written_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "STAMP", tmp_path / "installed")
    monkeypatch.setattr(setup.os, "access", lambda path, mode: False)
    with pytest.raises(SystemExit, match="cannot be written"):
        setup.install_environment()


@pytest.mark.parametrize(
    ("has_cpu_build", "locks", "said"),
    [
        (True, ["torch-cpu.txt"], "torch: the CPU build"),
        (False, ["torch-cpu.txt", "torch.txt"], "the plain one is taken"),
    ],
)
def test_torch_is_a_build_whose_hash_is_known(monkeypatch, capsys, has_cpu_build, locks, said):
    commands = []
    monkeypatch.setattr(setup, "succeeds", lambda *call: commands.append(call) or has_cpu_build)
    monkeypatch.setattr(setup, "run", lambda *call: commands.append(call))
    setup.install_torch()
    assert [command[-1].name for command in commands] == locks
    assert all("--require-hashes" in command for command in commands)
    assert said in capsys.readouterr().out


def test_missing_system_packages_are_named_and_never_fail(tmp_path):
    """Without apt-get and without the right to install: one command to type, and the loss."""
    script = ROOT / "book" / "setup.py"
    code = f"import runpy; runpy.run_path({str(script)!r})['install_system_packages']()"
    done = subprocess.run(
        [sys.executable, "-c", code], env={"PATH": str(tmp_path)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "sudo apt-get install --yes --no-install-recommends chromium" in done.stdout
    assert "in a browser" in done.stdout
