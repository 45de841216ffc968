"""Real changes of the code, and of packages, are caught by the witnesses; clean-ups are not.

Each is planted in a copy of the project, where the slices that it concerns are computed again. To
see the outcome of all of them: pytest -m slow tests/unit/test_planted_changes.py
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.slow

# Where it is planted, what is replaced by what, and the slices that are computed again.
CHANGES = {
    "sign in a gradient": (
        "ipo/lqr.py",
        "torch.baddbmm(RF, B.mT,",
        "torch.baddbmm(-RF, B.mT,",
        "lqr/curves",
    ),
    "order of draws": (
        "ipo/lqr.py",
        "        A = contraction * random_orthogonal(random, dim_state, dim_state)\n"
        "        W_c = random_orthogonal(random, dim_state, dim_state)\n",
        "        W_c = random_orthogonal(random, dim_state, dim_state)\n"
        "        A = contraction * random_orthogonal(random, dim_state, dim_state)\n",
        "lqr/closed_form",
    ),
    "Phi moves after the players": (
        "ipo/game.py",
        "    if move_phi is not None:  # lines 2 to 6\n        move_phi()\n"
        "    for _ in range(num_inner_rounds):  # line 7\n"
        "        for d in range(num_moves):  # line 8\n"
        "            respond(d)",
        "    for _ in range(num_inner_rounds):\n"
        "        for d in range(num_moves):\n"
        "            respond(d)\n"
        "    if move_phi is not None:\n        move_phi()\n",
        "causality/digits",
    ),
    "weight of a player in the average": (
        "ipo/game.py",
        "first = slope(cost, self.policy, share)",
        "first = slope(cost, self.policy, 1.0)",
        "algorithm/table",
    ),
    "ownership of an ensemble": (
        "ipo/game.py",
        '"ensemble": [Move(d, everything) for d in everything]',
        '"ensemble": [Move(d, [d]) for d in everything]',
        "algorithm/ablation",
    ),
    "clip range": (
        "ipo/ppo.py",
        "ratio.clamp(1 - settings.clip, 1 + settings.clip)",
        "ratio.clamp(1 - settings.clip, 1 + 2 * settings.clip)",
        "keys/curves",
    ),
    "discount": (
        "ipo/rollouts.py",
        "self.discount * self.gae_lambda",
        "self.gae_lambda",
        "keys/curves",
    ),
    "off by one in the horizon": (
        "ipo/worlds/tabular.py",
        "self.step_count == len(table.goal_reward)",
        "self.step_count == len(table.goal_reward) - 1",
        "keys/curves",
    ),
    "a term of the reward": (
        "ipo/worlds/door.py",
        "30 * np.abs(door_angle)",
        "29 * np.abs(door_angle)",
        "door/gaps",  # the policies there open doors; the first update of a training does not
    ),
    "gradient of a Gaussian's entropy": (
        "ipo/distributions.py",
        "(standard.square() - 1) + entropy_weight",
        "(standard.square() - 1) + 1.5 * entropy_weight",
        "door/curves",
    ),
    "mean for sum in a penalty": (
        "ipo/causality/predictors.py",
        ".square().mean(-1)",
        ".square().sum(-1)",
        "causality/linear",
    ),
    "rewards of the evaluation": (
        "ipo/own_domains/__init__.py",
        "returns += running * step.reward",
        "returns += step.reward",
        "your_own_domains",
    ),
}

# A package that does something else than before, as after an upgrade.
PACKAGES = {
    "torch: another default of Adam": (
        "import torch\n"
        "start = torch.optim.AdamW.__init__\n"
        "start.__defaults__ = tuple(\n"
        "    (0.9, 0.99) if d == (0.9, 0.999) else d for d in start.__defaults__\n"
        ")\n",
        "algorithm/table",
    ),
    "minigrid: another reward": (
        "from minigrid.minigrid_env import MiniGridEnv\n"
        "MiniGridEnv._reward = lambda self: 1 - 0.8 * self.step_count / self.max_steps\n",
        "keys/grids",
    ),
    "gymnasium: another pole": (
        "from gymnasium.envs.classic_control.cartpole import CartPoleEnv\n"
        "old = CartPoleEnv.__init__\n"
        "def new(self, *args, **kwargs):\n"
        "    old(self, *args, **kwargs)\n"
        "    self.force_mag = 11.0\n"
        "CartPoleEnv.__init__ = new\n",
        "your_own_domains",
    ),
    "numpy: another order of permutations": (
        "import numpy as np\n"
        "class Generator(np.random.Generator):\n"
        "    def permutation(self, x, axis=0):\n"
        "        return super().permutation(x, axis)[::-1]\n"
        "default_rng = np.random.default_rng\n"
        "np.random.default_rng = lambda seed=None: Generator(default_rng(seed).bit_generator)\n",
        "causality/digits",
    ),
}

CLEAN_UPS = {
    "a name": ("ipo/game.py", r"\bshare\b", "part_of_one", "algorithm/table"),
    "an error's text": (
        "ipo/checks.py",
        "must not name a value twice",
        "must name no value twice",
        "lqr/closed_form",
    ),
    "a docstring": ("ipo/lqr.py", '"""Solve ``P', '"""By doubling, solve ``P', "lqr/curves"),
    "a function split": (
        "ipo/lqr.py",
        r"    negligible = math.sqrt\(torch.finfo\(M.dtype\).eps\) / 4\n",
        "    negligible = _negligible(M.dtype)\n",
        "lqr/optimizers",
        "\n\ndef _negligible(dtype):\n    return math.sqrt(torch.finfo(dtype).eps) / 4\n",
    ),
    "a private function renamed": (
        "ipo/worlds/door.py",
        r"\b_add_panel\b",
        "_hang_the_panel",
        "door/success",
    ),
    "a constant given a name": (
        "ipo/worlds/door.py",
        r"30 \* np.abs\(door_angle\)",
        "PER_RADIAN * np.abs(door_angle)",
        "door/curves",
        "\n\nPER_RADIAN = 30\n",
    ),
    "a loop for a comprehension": (
        "ipo/ppo.py",
        r"    columns = \[(chosen_rows.*) for x in (.*)\]\n",
        "    columns = []\n"
        r"    for x in \2:"
        "\n"
        r"        columns.append(\1)"
        "\n",
        "keys/curves",
    ),
    "an argument by name": (
        "ipo/distributions.py",
        r"parameters.chunk\(2, -1\)",
        "parameters.chunk(2, dim=-1)",
        "door/curves",
    ),
    "another order of functions": (
        "ipo/causality/predictors.py",
        r"(?s)(def irm_penalties.*?\n\n\n)(@checked\ndef vrex.*?\n\n\n)",
        r"\2\1",
        "causality/digits",
    ),
    "blank lines and comments": ("ipo/rollouts.py", r"\n\n\n", "\n\n\n# -----\n\n", "keys/curves"),
    "a function of a run renamed inside": (
        "notebooks/experiments/games/scalar.py",
        r"\btraining\b",
        "costs_of_training",
        "algorithm/random",
    ),
}


@pytest.fixture
def project(tmp_path) -> Path:
    """A copy of the code, with the data of the original."""
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    shutil.copytree(ROOT / "ipo", tmp_path / "ipo", ignore=ignored)
    code = tmp_path / "notebooks" / "experiments"
    shutil.copytree(ROOT / "notebooks" / "experiments", code, ignore=ignored)
    (tmp_path / "data").symlink_to(ROOT / "data")
    return tmp_path


def verify(project: Path, slices: str, package: str = "") -> subprocess.CompletedProcess:
    """Compute slices again with the project's code, after what a package would do otherwise."""
    call = "import sys; from experiments.witness import verify; found = verify(sys.argv[1:], 1)"
    report = "print(*found, sep='\\n'); sys.exit(len(found) > 0)"
    return subprocess.run(
        [sys.executable, "-c", f"{package}\n{call}\n{report}", slices],
        cwd=project,
        env=os.environ | {"PYTHONPATH": f"{project}{os.pathsep}{project / 'notebooks'}"},
        capture_output=True,
        text=True,
    )


def plant(project: Path, path: str, pattern: str, replacement: str, more: str = "") -> None:
    text = (project / path).read_text()
    changed = re.sub(pattern, replacement, text) + more
    assert changed != text, f"{path}: has no {pattern!r}"
    (project / path).write_text(changed)


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_real_change_is_caught(project, change):
    path, old, new, slices = change
    plant(project, path, re.escape(old), new.replace("\\", "\\\\"))
    done = verify(project, slices)
    assert done.returncode == 1, done.stderr
    assert " recorded, " in done.stdout, done.stdout


@pytest.mark.parametrize("change", PACKAGES.values(), ids=PACKAGES.keys())
def test_a_package_that_changes_is_caught(project, change):
    package, slices = change
    done = verify(project, slices, package)
    assert done.returncode == 1, done.stderr
    assert " recorded, " in done.stdout, done.stdout


@pytest.mark.parametrize("change", CLEAN_UPS.values(), ids=CLEAN_UPS.keys())
def test_a_clean_up_is_not_flagged(project, change):
    path, old, new, slices, *more = change
    plant(project, path, old, new, *more)
    done = verify(project, slices)
    assert done.returncode == 0, done.stdout + done.stderr
