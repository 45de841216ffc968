"""Networks act and learn on the device that they are given, and learn the same there."""

from contextlib import nullcontext

import pytest
import torch
import torch.optim.optimizer as torch_optimizer
from other_device import DEVICE, OtherDevice
from test_training import SMALL, Counting

from ipo.distributions import Categorical, Gaussian
from ipo.networks import DenseNetwork
from ipo.ppo import PPOSettings, Training
from ipo.worlds.networks import GridNetwork, OnTable

SETTINGS = PPOSettings(
    "ipo", normalize_rewards=True, normalize_advantages="minibatch", **(SMALL | {"num_steps": 8})
)


class Choosing(Counting):
    """Counting, paid by the number of an action; what is seen are rows of a table, or numbers."""

    def __init__(self, *shape: int, seen: torch.dtype = torch.float32) -> None:
        super().__init__(*shape)
        self.seen = seen

    def reset(self):
        return self._seen(super().reset())

    def step(self, actions):
        step = super().step(actions.unsqueeze(-1).float())
        rest = step._replace(last_observation=self._seen(step.last_observation))
        return rest._replace(observation=self._seen(step.observation))

    def _seen(self, count):
        return count if self.seen == torch.float32 else count.squeeze(-1).to(self.seen)


def images():
    return torch.rand(6, 7, 7, 3, generator=torch.Generator().manual_seed(0))


TASKS = {
    "numbers": (lambda: DenseNetwork(1, 1, Gaussian, hidden=(8,)), Counting),
    "choices": (lambda: DenseNetwork(1, 3, Categorical, hidden=(8,)), Choosing),
    "table": (
        lambda: OnTable(GridNetwork(3, 3), images()),
        lambda *shape: Choosing(*shape, seen=torch.int64),
    ),
}


def trained(task: str, device: torch.device | str) -> list[dict[str, torch.Tensor]]:
    """Players after an update, and one more of a training that goes on from its state."""
    network, environments = TASKS[task]

    def training(device: torch.device | str) -> Training:
        def make(domains, num_copies, generators):
            return environments(len(generators), sum(num_copies))

        return Training(network(), make, 2, SETTINGS, [0, 1], device)

    first, second = training("cpu"), training(device)
    first.update()
    second.restore(first.state())
    second.update()
    assert {w.device.type for p in second.players for w in p.values()} == {
        torch.device(device).type
    }
    return [{name: w.detach().cpu() for name, w in p.items()} for p in second.players]


@pytest.mark.parametrize(
    "device",
    [
        DEVICE,
        pytest.param(
            "cuda",
            marks=pytest.mark.skipif(
                not torch.cuda.is_available(), reason="torch finds no CUDA device here"
            ),
        ),
    ],
    ids=str,
)
@pytest.mark.parametrize("task", TASKS)
def test_training_is_the_same_on_another_device(task, device, monkeypatch):
    known = torch_optimizer._get_fused_kernels_supported_devices()
    monkeypatch.setattr(
        torch_optimizer, "_get_fused_kernels_supported_devices", lambda: [*known, DEVICE.type]
    )
    here = trained(task, "cpu")
    with OtherDevice() if device == DEVICE else nullcontext():
        there = trained(task, device)
    tolerance = 1e-6 if device == DEVICE else 1e-4
    for one, other in zip(here, there, strict=True):
        torch.testing.assert_close(other, one, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("device", ["gpu", "lazy"])
def test_a_device_that_is_not_there_is_named(device):
    with pytest.raises(ValueError, match=f"device = '{device}': must be one that torch can use: "):
        trained("numbers", device)


def test_a_tensor_that_does_not_follow_is_caught():
    with OtherDevice(), pytest.raises(RuntimeError, match=r"add\.Tensor: .* \(2,\) are on the CPU"):
        torch.ones(2) + torch.ones(2).to(DEVICE)
