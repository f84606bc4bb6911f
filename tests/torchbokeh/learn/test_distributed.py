"""Many processes and many threads: gradients of `DistributedDataParallel`, and data workers that keep to one core.

What has to run in fresh processes is in this file as well, which then is a script: ``test_distributed.py NAME ...``
calls the function of that name.
"""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Dataset

import torchbokeh as tb
from torchbokeh.ops.system import threads as _threads
from torchbokeh.plan.plan import Plan

LIMIT = 300
"""Seconds after which a process counts as stuck."""

PROCESSES = 2
SIZE = (40, 48)
QUALITIES = ("exact", "balanced")
TASKS = Path("/proc/self/task")


@contextmanager
def scripts(*commands: list[str]) -> Iterator[list["subprocess.Popen[str]"]]:
    """Functions of this file, each in a process of its own that is gone in the end."""
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    if sys.platform == "linux":
        env["GLOO_SOCKET_IFNAME"] = "lo"  # whatever this machine calls itself, and whether that can be looked up
    started: list[subprocess.Popen[str]] = []
    try:
        for command in commands:
            pipe = subprocess.PIPE
            line = [sys.executable, "-P", __file__, *command]
            started.append(subprocess.Popen(line, env=env, stdout=pipe, stderr=pipe, text=True))
        yield started
    finally:
        for process in started:
            process.kill()
            process.communicate()


def finish(*commands: list[str]) -> None:
    with scripts(*commands) as started:
        for process in started:
            _, said = process.communicate(timeout=LIMIT)
            assert process.returncode == 0, said


class Network(nn.Module):
    """A depth network as small as they come, and a lens that is learned with it."""

    def __init__(self, quality: str) -> None:
        super().__init__()
        self.depth = nn.Conv2d(3, 1, 3, padding=1, padding_mode="reflect")
        with torch.no_grad():
            self.depth.weight.copy_(torch.linspace(-0.5, 0.6, 27).view(1, 3, 3, 3))
            self.depth.bias = nn.Parameter(torch.tensor([-1.0]))
        focus, number = nn.Parameter(torch.tensor(3.0)), nn.Parameter(torch.tensor(1.8))
        lens = tb.ThinLens(focal_length=0.05, f_number=number, focus_distance=focus, sensor_width=8e-4)
        self.blur = tb.LensBlur(lens, quality=quality)

    def distance(self, image: Tensor) -> Tensor:
        return 1 + 6 * self.depth(image).sigmoid()

    def forward(self, image: Tensor, plan: Plan | None) -> Tensor:
        return self.blur(image, self.distance(image), plan=plan)


def batch() -> tuple[Tensor, Tensor]:
    """Pictures of different brightness, so that their depths have different ranges; and what they are compared with."""
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(2 * PROCESSES, 3, *SIZE, generator=draw) * torch.linspace(0.3, 3, 2 * PROCESSES).view(
        -1, 1, 1, 1
    )
    return image, torch.rand(image.shape, generator=draw)


def gradients(model: nn.Module, image: Tensor, target: Tensor, plan: Plan | None) -> dict[str, Tensor]:
    model.zero_grad()
    (model(image, plan) - target).square().mean().backward()
    return {name.removeprefix("module."): p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def whole_plan(network: Network) -> Plan:
    image, _ = batch()
    return network.blur.plan(image, network.distance(image))


def train(rank: str, store: str, out: str) -> None:
    """One of the processes: gradients on its share of the batch, with the plan of the whole batch and with its own."""
    torch.set_num_threads(1)
    wait = timedelta(seconds=LIMIT / 2)
    dist.init_process_group("gloo", init_method=store, rank=int(rank), world_size=PROCESSES, timeout=wait)
    image, target = (t.chunk(PROCESSES)[int(rank)] for t in batch())
    found = {}
    for quality in QUALITIES:
        network = Network(quality)
        model = DistributedDataParallel(network)
        for name, plan in (("one plan", whole_plan(network)), ("own plans", None)):
            found[f"{quality}, {name}"] = gradients(model, image, target, plan)
    torch.save(found, out)
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def shares(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, dict[str, Tensor]]]:
    """What every process found."""
    folder = tmp_path_factory.mktemp("processes")
    store = (folder / "store").as_uri()
    outs = [folder / f"{rank}.pt" for rank in range(PROCESSES)]
    finish(*(["train", str(rank), store, str(out)] for rank, out in enumerate(outs)))
    return [torch.load(out) for out in outs]


def off(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> float:
    """The largest relative error of the gradient of any parameter."""
    assert found.keys() == wanted.keys()
    assert all(float(value.norm()) > 1e-6 for value in wanted.values())
    return max(float((found[name] - value).norm() / value.norm()) for name, value in wanted.items())


@pytest.mark.slow
@pytest.mark.parametrize("quality", QUALITIES)
def test_processes_have_the_gradients_of_one_process(quality: str, shares: list[Any]) -> None:
    """With one plan for all, and with a plan of its own for every picture, which is that of the picture alone."""
    network = Network(quality)
    plan = whole_plan(network)
    assert plan.hidden == "filled"
    assert (plan.highest > 0) == (quality == "balanced")
    wanted = gradients(network, *batch(), plan)
    assert set(wanted) == {"depth.weight", "depth.bias", "blur.lens.f_number", "blur.lens.focus_distance"}
    assert all(off(found[f"{quality}, one plan"], wanted) < 1e-5 for found in shares)
    alone = gradients(network, *batch(), None)
    assert all(off(found[f"{quality}, own plans"], alone) < 1e-5 for found in shares)
    assert off(alone, wanted) > 1e-5  # bins follow the range of blur


@contextmanager
def started() -> Iterator[list[int]]:
    """The number of threads alive after each start of one by a kernel."""
    counts: list[int] = []

    class Counted(threading.Thread):
        def start(self) -> None:
            super().start()
            counts.append(threading.active_count())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_threads, "threading", SimpleNamespace(Thread=Counted))
        yield counts


def tasks() -> int:
    """Threads of this process, whichever library started them; 0 where the system does not tell."""
    return len(list(TASKS.iterdir())) if TASKS.exists() else 0


def blurred(quality: str) -> dict[str, Any]:
    """Blurred pictures and a gradient, and what threads that took."""
    size = 150, SIZE[1]  # pieces of work are bands of up to 64 rows
    image = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0))
    coc = torch.linspace(-9, 12, SIZE[1]).expand(2, 1, *size).contiguous().requires_grad_()
    before = tasks()
    with started() as counts:
        out = tb.LensBlur(quality=quality)(image, coc=coc)
        (slope,) = torch.autograd.grad(out.square().sum(), coc)
    limit = torch.get_num_threads()
    return {"out": out.detach(), "slope": slope, "threads": limit, "counts": counts, "tasks": (before, tasks())}


class Blurred(Dataset[list[dict[str, Any]]]):
    """A single sample: a worker that has sent one starts threads of its own, to send it."""

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> list[dict[str, Any]]:
        return [blurred(quality) for quality in QUALITIES]


def load(method: str, out: str) -> None:
    """The same work in this process, on two threads, and then in a data worker."""
    torch.set_num_threads(2)
    large = torch.rand(1000, 1000)
    float((large @ large).exp().sum())  # torch's own pool is up as well
    settings: dict[str, Any] = {"num_workers": 1, "multiprocessing_context": method, "timeout": LIMIT / 2}
    here = Blurred()[0]
    (there,) = DataLoader(Blurred(), batch_size=None, **settings)
    torch.save((here, there), out)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_data_worker_keeps_to_one_thread(method: str, tmp_path: Path) -> None:
    if method not in torch.multiprocessing.get_all_start_methods():
        pytest.skip(f"this system cannot {method}")
    finish(["load", method, str(tmp_path / "found.pt")])
    here, there = torch.load(tmp_path / "found.pt")
    assert len(here) == len(there) == len(QUALITIES)
    for one, other in zip(here, there, strict=True):
        assert (one["threads"], other["threads"]) == (2, 1)
        assert len(one["counts"]) > 0  # this test sees threads where there are some
        assert other["counts"] == []
        assert torch.equal(one["out"], other["out"])
        assert torch.equal(one["slope"], other["slope"])
        before, after = other["tasks"]
        assert before == after


@pytest.mark.parametrize("count", [1, 2, 8])
def test_work_is_done_by_as_many_threads_as_torch_is_told(count: int) -> None:
    """Whatever the number of cores: the first pieces wait for each other, so that no thread does two of them."""
    torch.set_num_threads(count)
    meet = threading.Barrier(count)
    seen: list[tuple[int, int]] = []

    def work(k: int) -> None:
        if k < count:
            meet.wait(LIMIT)
        seen.append((k, threading.get_ident()))

    with started() as counts:
        _threads.run_all(work, [(k,) for k in range(4 * count)])
    assert sorted(k for k, _ in seen) == list(range(4 * count))
    assert len({thread for k, thread in seen if k < count}) == count
    assert len(counts) == count - 1


@pytest.mark.parametrize("quality", QUALITIES)
def test_more_threads_than_cores_give_the_same_bits(quality: str) -> None:
    alone = blurred(quality)
    torch.set_num_threads(8)
    many = blurred(quality)
    assert alone["counts"] == []
    assert 1 < max(many["counts"]) <= 8
    assert torch.equal(many["out"], alone["out"])
    assert torch.equal(many["slope"], alone["slope"])


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
