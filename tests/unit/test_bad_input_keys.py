"""Bad input to the coloured keys and to training: an error before any work, and nothing written.

Every message names the parameter or the file, its value and the rule. What a table cannot describe
is in ``test_tabular.py``, settings with which a training of two players cannot begin also in
``test_training.py``.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from test_bad_input import INF, NAN

import ipo  # noqa: F401  (registers the environment)
from experiments.keys import Cell, encode, published, run_cell
from experiments.policies import load_policy, save_policy
from experiments.sealed import DamagedError, write_sealed
from experiments.tabulated import load_or_tabulate
from ipo.networks import Weights
from ipo.ppo import PPOSettings, Training
from ipo.worlds.colored_keys import ColoredKeysEnv
from ipo.worlds.minigrid_tables import NotTabularError
from ipo.worlds.networks import GridNetwork
from ipo.worlds.vector_environments import FromGymnasium

# -------------------------------------------------------------------------- environment


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 4}, r"^size = 4: must be at least 5"),
        ({"color": "pink"}, r"^color = 'pink': must be one of red, green"),
    ],
)
def test_no_table_of_an_environment_that_cannot_be(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        load_or_tabulate(ColoredKeysEnv, tmp_path, **options)
    assert list(tmp_path.glob("*.table")) == []


def test_no_table_of_a_random_environment(tmp_path, monkeypatch):
    """Nothing is left in the folder of tables that a later call could load."""
    original = ColoredKeysEnv.step

    def drifting(env: ColoredKeysEnv, action: int) -> tuple:
        env.agent_dir = int(env.np_random.integers(0, 4))
        return original(env, action)

    monkeypatch.setattr(ColoredKeysEnv, "step", drifting)
    with pytest.raises(NotTabularError, match=r"^env = .*: must be deterministic, but action 0"):
        load_or_tabulate(ColoredKeysEnv, tmp_path, color="red")
    assert list(tmp_path.glob("*.table")) == []


# ----------------------------------------------------------------------------- settings


def test_misspelt_setting():
    with pytest.raises(TypeError, match="num_env"):
        published("ppo", num_env=48)


# ----------------------------------------------------------------------------- training


def nothing_must_happen(*arguments: object) -> None:
    raise AssertionError("nothing must be drawn, made or trained")


class NoNetwork(GridNetwork):
    """Nobody asks for its weights."""

    start = nothing_must_happen


def begin(settings: PPOSettings, num_domains: int, seeds: object) -> Training:
    return Training(NoNetwork(), nothing_must_happen, num_domains, settings, seeds)


@pytest.mark.parametrize(
    ("method", "num_domains", "changes", "message"),
    [
        ("ppo", 2, {"num_envs": 47}, r"^num_envs = 47: must be a multiple of 2, to be split"),
        ("ipo", 3, {"num_envs": 46}, r"^num_envs = 46: must be a multiple of 3, to be split"),
        ("ipo", 5, {}, r"^num_envs = 48: must be a multiple of 5, to be split evenly"),
        ("ensemble", 2, {"num_envs": 6}, r"^num_envs = 6: must be a multiple of 4, to be split"),
        ("ensemble", 3, {"num_envs": 48}, r"^num_envs = 48: must be a multiple of 9, to be"),
        (
            "ppo",
            2,
            {"minibatch_size": 6145},
            r"^minibatch_size = 6145: must be at most 6144, the frames of a player's rollout",
        ),
        (
            "ipo",
            2,
            {"minibatch_size": 4096},
            r"^minibatch_size = 4096: must be at most 3072, the frames of a player's rollout",
        ),
        (
            "ppo",
            2,
            {"num_envs": 2, "num_steps": 100},
            r"^minibatch_size = 256: must be at most 200",
        ),
    ],
)
def test_training_that_cannot_begin(method, num_domains, changes, message):
    with pytest.raises(ValueError, match=message):
        begin(published(method, **changes), num_domains, [0])


@pytest.mark.parametrize(
    ("mode", "num_envs", "num_runs", "message"),
    [
        (AutoresetMode.NEXT_STEP, 4, 2, r"^envs: have autoreset_mode = .*, must have SAME_STEP"),
        (AutoresetMode.DISABLED, 4, 2, r"^envs: have autoreset_mode = .*, must have SAME_STEP"),
        (AutoresetMode.SAME_STEP, 5, 2, r"^envs: 5 copies, must be a multiple of 2 runs"),
    ],
)
def test_vector_environment_that_does_not_fit(mode, num_envs, num_runs, message):
    envs = SyncVectorEnv([ColoredKeysEnv] * num_envs, autoreset_mode=mode)
    with pytest.raises(ValueError, match=message):
        FromGymnasium(envs, num_runs, seed=0)


# --------------------------------------------------------------------------- experiment


@pytest.mark.parametrize(
    ("cell", "seeds", "message"),
    [
        (Cell("ppo", published("ppo"), size=4), [0], r"^size = 4: must be at least 5"),
        (Cell("ppo", published("ppo", num_envs=5)), [0], r"^num_envs = 5: must be a multiple of 2"),
        (Cell("ipo", published("ipo", minibatch_size=5000)), [0], r"^minibatch_size = 5000: must"),
        (Cell("ppo", published("ppo")), [0, 0], r"^seeds = \[0, 0\]: must not name a value twice"),
        (Cell("ppo", published("ppo")), [], r"^seeds = \[\]: must be at least 1 long"),
    ],
)
def test_cell_that_cannot_be_run_saves_no_policy(tmp_path, tables, keys, cell, seeds, message):
    with pytest.raises(ValueError, match=message):
        run_cell(cell, seeds, tables, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_encoding_that_does_not_exist(keys):
    with pytest.raises(ValueError, match=r"^color_encoding = 'onehot': must be one of integer"):
        encode(keys["red"].images, "onehot")


# ---------------------------------------------------------------------- files of policies

NETWORK = GridNetwork()


def saved(path: Path, change: Callable[[dict[str, torch.Tensor]], object] = len) -> Path:
    """The policy of one player and two runs in a file, changed by ``change(tensors)``."""
    player = NETWORK.start([np.random.default_rng(run) for run in range(2)])
    change(player)
    save_policy(path / "policy.safetensors", [player], {"cell": "ppo_red", "seeds": [0, 1]})
    return path / "policy.safetensors"


def assign(name: str, value: float) -> Callable[[Weights], None]:
    def change(player: Weights) -> None:
        player[name][1, ..., 3] = value

    return change


def reshape(name: str, *shape: int) -> Callable[[Weights], None]:
    def change(player: Weights) -> None:
        player[name] = torch.zeros(shape)

    return change


FILES = {
    "NaN": (assign("conv2.weight", NAN), r"conv2\.weight of player 0 holds NaN or infinite"),
    "infinite": (assign("actor2.bias", INF), r"actor2\.bias of player 0 holds NaN or infinite"),
    "minus infinite": (assign("critic1.weight", -INF), r"critic1\.weight .* NaN or infinite"),
    "more units": (
        reshape("actor1.weight", 2, 64, 65),
        r"actor1\.weight of player 0 has shape \(64, 65\), needs \(64, 64\)",
    ),
    "transposed": (
        reshape("conv1.weight", 2, 16, 12),
        r"conv1\.weight of player 0 has shape \(16, 12\), needs \(12, 16\)",
    ),
    "no run axis": (
        reshape("conv1.weight", 12, 16),
        r"conv1\.weight of player 0 has shape \(16,\), needs \(12, 16\)",
    ),
    "missing layer": (
        lambda player: player.pop("critic2.bias"),
        r"critic2\.bias of player 0 has shape nothing, needs \(1,\)",
    ),
}


@pytest.mark.parametrize(("change", "message"), FILES.values(), ids=FILES.keys())
def test_policy_with_wrong_weights(tmp_path, change, message):
    path = saved(tmp_path, change)
    with pytest.raises(ValueError, match=rf"^{path}: {message}"):
        load_policy(path, NETWORK)


def test_policy_whose_layers_differ_in_the_number_of_runs(tmp_path):
    path = saved(tmp_path, reshape("conv1.bias", 3, 16))
    with pytest.raises(ValueError, match=rf"^{path}: conv1\.bias of player 0 .* runs"):
        load_policy(path, NETWORK)


@pytest.mark.parametrize("network", [GridNetwork(8), GridNetwork(2), GridNetwork(3, 6)])
def test_policy_for_another_network(tmp_path, network):
    path = saved(tmp_path)
    message = rf"^{path}: \w+\.(weight|bias) of player 0 has shape \(.*\), needs \(.*\)"
    with pytest.raises(ValueError, match=message):
        load_policy(path, network)


@pytest.mark.parametrize(
    ("about", "message"),
    [
        ({"cell": "ppo_green"}, "cell = 'ppo_red', asked for 'ppo_green'"),
        ({"cell": "ppo_red", "seeds": [0]}, r"seeds = \[0, 1\], asked for \[0\]"),
        ({"size": 6}, "size = None, asked for 6"),
    ],
)
def test_policy_that_was_made_for_something_else(tmp_path, about, message):
    path = saved(tmp_path)
    with pytest.raises(ValueError, match=rf"^{path}: was made for something else: {message}"):
        load_policy(path, NETWORK, about)


@pytest.mark.parametrize("share", [0, 0.0001, 0.01, 0.5, 0.99999])
def test_policy_cut_short(tmp_path, share):
    path = saved(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DamagedError, match=rf"^{path}: is cut short or changed"):
        load_policy(path, NETWORK)


def test_every_changed_bit_of_a_policy_is_found(tmp_path):
    """All bits of the seal, of what follows it and of the header's length; a sample of the rest."""
    path = saved(tmp_path)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    places = [*range(75), *rng.integers(75, len(content), 125)]
    for place in places:
        changed = bytearray(content)
        changed[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        with pytest.raises(DamagedError, match=rf"^{path}: is cut short or changed"):
            load_policy(path, NETWORK)


def test_policy_of_another_format(tmp_path):
    path = tmp_path / "policy.safetensors"
    torch.save({"0.conv1.weight": torch.zeros(1)}, path)
    with pytest.raises(DamagedError, match=rf"^{path}: is cut short or changed"):
        load_policy(path, NETWORK)


def test_policy_that_does_not_exist(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.safetensors"):
        load_policy(tmp_path / "nowhere.safetensors", NETWORK)


@pytest.mark.parametrize(
    ("names", "metadata", "message"),
    [
        (["0.conv1.weight"], None, "holds no 'about' with its tensors"),
        (["0.conv1.weight"], {"cell": "ppo_red"}, "holds no 'about' with its tensors"),
        (["0.conv1.weight"], {"about": "{"}, "holds no 'about' with its tensors"),
        ([], {"about": "{}"}, "must hold .* weights of each player"),
        (["weight"], {"about": "{}"}, "conv1.weight of player 0 has shape nothing"),
        (["999999999.conv1.weight"], {"about": "{}"}, "conv1.weight of player 0 has shape nothing"),
        ([f"0.{n}" for n in range(20)], {"about": "{}"}, "must hold 14 weights of each player"),
    ],
)
def test_sealed_file_that_is_no_policy(tmp_path, names, metadata, message):
    path = tmp_path / "policy.safetensors"
    tensors = {name: torch.zeros(1, 12, 16) for name in names}
    write_sealed(path, safetensors.torch.save(tensors, metadata))
    with pytest.raises(ValueError, match=rf"^{path}: {message}"):
        load_policy(path, NETWORK)
