"""Many threads, many processes, many calls: the same bits as one quiet call, and nothing that piles up."""

import ctypes
import faulthandler
import gc
import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import torchbokeh as tb
from torchbokeh.ops.system.threads import run_all
from torchbokeh.scenes import ProceduralDataset

THREADS = 16
INPUTS = 4  # different ones; thread k starts with the k-th
PATIENCE = 240.0  # seconds until something counts as a deadlock

Work = Callable[[int], tuple[Tensor, ...]]


def picture(k: int, size: tuple[int, int] = (16, 20)) -> tuple[Tensor, Tensor, Tensor]:
    """A picture, its signed CoC and its motion: others for each k, with a foreground, and of other largest radii."""
    draw = torch.Generator().manual_seed(k)
    image = torch.rand(1, 3, *size, generator=draw) + 20 * (torch.rand(1, 1, *size, generator=draw) > 0.99)
    coc = (3 + k) * torch.rand(1, 1, *size, generator=draw)
    coc[..., : size[1] // 3] = -4.0 - k
    motion = (2 + k) * torch.rand(1, 2, *size, generator=draw) - 1
    return image, coc, motion


def layered(k: int, size: tuple[int, int] = (16, 20)) -> tuple[Tensor, Tensor]:
    """Two premultiplied layers and their signed CoC."""
    draw = torch.Generator().manual_seed(100 + k)
    alpha = torch.rand(1, 2, 1, *size, generator=draw).round()
    alpha[:, 1] = 1
    colour = torch.rand(1, 2, 3, *size, generator=draw) * alpha
    coc = torch.stack([torch.full((1, 1, *size), -3.0 - k), torch.full((1, 1, *size), 5.0 + k)], 1)
    return torch.cat([colour, alpha], 2), coc


def with_gradients(module: Callable[..., Tensor], *inputs: Tensor, **maps: Tensor) -> tuple[Tensor, ...]:
    """What a module makes of its inputs, and its gradients to all of them."""
    given = [t.clone().requires_grad_() for t in inputs]
    named = {name: t.clone().requires_grad_() for name, t in maps.items()}
    out = module(*given, **named)
    loss = out.square().mean()
    return (out.detach(), *torch.autograd.grad(loss, [*given, *named.values()], materialize_grads=True))


def works() -> dict[str, Work]:
    """One module of each kind, which all threads share."""
    exact, balanced, layers = tb.LensBlur(), tb.LensBlur(quality="balanced"), tb.LensBlur(quality="balanced")
    hexagons, glass = tb.LensBlur(aperture="6-gon"), tb.Dispersion("BK7", 1.0)
    lens = tb.LensBlur(tb.ThinLens(0.05, 0.2, 2.0, 0.036, dispersion=glass))
    splatting, capsules = tb.KernelSplatting(), tb.KernelSplatting(bank=tb.PsfBank.load("combined"))
    views = tb.AccumulationBuffer(views=8, subsamples=4)
    integrators = [tb.ScanlineIntegrator(), tb.FFTIntegrator(), tb.PyramidIntegrator()]

    def accumulated(k: int) -> tuple[Tensor, ...]:
        source, coc = layered(k)
        return (views(source, coc=coc),)

    def integrated(k: int) -> tuple[Tensor, ...]:
        buffer = picture(k, (12 + k, 20))[0]
        return tuple(t for one in integrators for t in with_gradients(one, buffer))

    def in_depth(k: int) -> tuple[Tensor, ...]:
        image, coc, _ = picture(k)
        return with_gradients(lens, image, 2.0 + coc.abs())

    return {
        "exact": lambda k: with_gradients(exact, picture(k)[0], coc=picture(k)[1]),
        "balanced": lambda k: with_gradients(balanced, picture(k)[0], coc=picture(k)[1]),
        "no gradient": lambda k: (balanced(picture(k)[0], coc=picture(k)[1]),),
        "polygons": lambda k: with_gradients(hexagons, picture(k)[0], coc=picture(k)[1]),
        "motion": lambda k: with_gradients(balanced, picture(k)[0], coc=picture(k)[1], motion=picture(k)[2]),
        "layers": lambda k: with_gradients(layers, layered(k)[0], coc=layered(k)[1]),
        "dispersion": in_depth,
        "splatting": lambda k: with_gradients(splatting, *picture(k)[:2]),
        "bank": lambda k: (capsules(picture(k)[0], picture(k)[1], motion=picture(k)[2]),),
        "views": accumulated,
        "integrators": integrated,
    }


def digest(tensors: tuple[Tensor, ...]) -> str:
    """A name for the very bits of some tensors."""
    found = hashlib.sha256()
    for t in tensors:
        found.update(repr(t.shape).encode() + t.contiguous().numpy().tobytes())
    return found.hexdigest()


@pytest.fixture(scope="module")
def quiet() -> dict[str, list[str]]:
    """What a single thread makes of the inputs, one after the other."""
    torch.set_num_threads(1)
    return {name: [digest(work(k)) for k in range(INPUTS)] for name, work in works().items()}


def share(modules: dict[str, Work], thread: int, kinds: int, inputs: int) -> dict[str, dict[int, str]]:
    """What one of many threads makes, with some of the modules, of some inputs; each begins with others."""
    names = sorted(modules)
    chosen = [names[(thread + k) % len(names)] for k in range(min(kinds, len(names)))]
    order = [(thread + k) % INPUTS for k in range(inputs)]
    return {name: {k: digest(modules[name](k)) for k in order} for name in chosen}


def all_at_once(kinds: int, inputs: int) -> list[dict[str, dict[int, str]]]:
    """The shares of many threads that call the same modules at the same time."""
    modules, start, errors = works(), threading.Barrier(THREADS), []
    found: list[dict[str, dict[int, str]]] = [{} for _ in range(THREADS)]

    def run(thread: int) -> None:
        try:
            start.wait(PATIENCE)
            found[thread] = share(modules, thread, kinds, inputs)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(k,), daemon=True) for k in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
        if thread.is_alive():
            faulthandler.dump_traceback()
            raise TimeoutError("a deadlock: see the tracebacks of all threads")
    if errors:
        raise errors[0]
    return found


def assert_all_equal(found: list[dict[str, dict[int, str]]], expected: dict[str, list[str]]) -> None:
    for thread, by_name in enumerate(found):
        assert by_name
        for name, digests in by_name.items():
            for k, one in digests.items():
                assert one == expected[name][int(k)], f"{name}, input {k}, thread {thread}: not what a quiet call makes"


def in_a_new_process(code: str, **environment: str) -> str:
    """The last line that a Python program prints; this file is its module ``test_load``."""
    start = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
    done = subprocess.run(
        [sys.executable, "-c", start + code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_threads_share_modules(quiet: dict[str, list[str]]) -> None:
    torch.set_num_threads(2)
    assert_all_equal(all_at_once(kinds=5, inputs=1), quiet)


@pytest.mark.slow
@pytest.mark.parametrize("inner", [1, 5])
def test_threads_share_modules_for_longer(quiet: dict[str, list[str]], inner: int) -> None:
    torch.set_num_threads(inner)
    assert_all_equal(all_at_once(kinds=99, inputs=2), quiet)


FIRST_CALL = f"""
import faulthandler, importlib, json, threading
faulthandler.dump_traceback_later({PATIENCE}, exit=True)
start, found = threading.Barrier({THREADS}), [None] * {THREADS}
def run(thread):
    start.wait()
    test = importlib.import_module("test_load")
    found[thread] = test.share(test.works(), thread, 3, 1)
threads = [threading.Thread(target=run, args=(k,)) for k in range({THREADS})]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(json.dumps(found))
"""


@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_very_first_call(quiet: dict[str, list[str]], compiled: bool, tmp_path: Path) -> None:
    """Imports, kernels and tables all begin in many threads at once."""
    environment = {} if compiled else {"NUMBA_CACHE_DIR": str(tmp_path)}
    assert_all_equal(json.loads(in_a_new_process(FIRST_CALL, **environment)), quiet)


class Blurred(Dataset[str]):
    """Names of blurred pictures and of the gradients to them."""

    def __init__(self) -> None:
        self.blur = tb.LensBlur(quality="balanced")

    def __len__(self) -> int:
        return 8

    def __getitem__(self, k: int) -> str:
        image, coc, motion = picture(k)
        return digest(with_gradients(self.blur, image, coc=coc, motion=motion))


class Made(Dataset[str]):
    """Names of procedural samples."""

    def __init__(self) -> None:
        self.samples = ProceduralDataset(seed=5, resolution=(16, 24), length=8, views=4)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, k: int) -> str:
        sample = self.samples[k]
        return digest((*(t for t in sample.values() if isinstance(t, Tensor)), *sample["lens"].values()))


def loaded(dataset: Dataset[str], context: str) -> list[str]:
    """All of a data set, by four worker processes."""
    return list(DataLoader(dataset, batch_size=None, num_workers=4, multiprocessing_context=context, timeout=PATIENCE))


@pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")  # more workers than processors
@pytest.mark.parametrize("dataset", [Blurred(), Made()], ids=["blurred", "made"])
def test_forked_workers(dataset: Dataset[str]) -> None:
    """Also after the parent has used several threads of torch's and of the kernels' itself."""
    expected = [dataset[k] for k in range(8)]
    torch.set_num_threads(3)
    assert float(torch.ones(1 << 20).sum()) == 1 << 20
    assert dataset[3] == expected[3]
    assert loaded(dataset, "fork") == expected


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["Blurred", "Made"])
def test_spawned_workers(kind: str) -> None:
    code = f"import json, test_load\nprint(json.dumps(test_load.loaded(test_load.{kind}(), 'spawn')))"
    dataset = {"Blurred": Blurred, "Made": Made}[kind]()
    assert json.loads(in_a_new_process(code)) == [dataset[k] for k in range(8)]


def held() -> tuple[int, int, int]:
    """Resident bytes, open files and threads of this process."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # or what was given back, in pieces, counts as held
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE"), len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))


def growth(calls: int, warm_up: int) -> tuple[int, int, int]:
    """What the process holds more of after many calls than after the first of them."""
    modules, draw = works(), torch.Generator().manual_seed(0)
    blurs = [tb.LensBlur(), tb.LensBlur(quality="balanced"), tb.LensBlur(aperture="5-gon", quality="high")]
    before = (0, 0, 0)
    for k in range(calls):
        if k == warm_up:
            before = held()
        size = tuple(torch.randint(8, 28, (2,), generator=draw).tolist())
        image, coc, motion = picture(k % 7, size)
        blur, radius = blurs[k % 3], float(torch.rand((), generator=draw)) / 4
        if k % 4 == 0:
            with_gradients(blur, image, coc=radius * coc)
        elif k % 4 == 1:
            blur(image, coc=coc)
        elif k % 4 == 2:
            with_gradients(blurs[k % 2], image, coc=radius * coc, motion=radius * motion)
        else:
            source, coc = layered(k % 9, size)
            with_gradients(blur, source, coc=radius * coc)
        if k % 10 == 0:
            modules["integrators"](k % 5)
            modules["bank"](k % 6)
            modules["views"](k % 8)
    return tuple(now - then for now, then in zip(held(), before, strict=True))  # type: ignore[return-value]


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux and its C library")
@pytest.mark.parametrize(("calls", "warm_up"), [(200, 120), pytest.param(2000, 300, marks=pytest.mark.slow)])
def test_many_calls_hold_nothing(calls: int, warm_up: int) -> None:
    held_more, files, threads = growth(calls, warm_up)
    assert held_more < 3 << 20
    assert (files, threads) == (0, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux")
def test_threads_of_kernels_are_gone_after_each_call() -> None:
    torch.set_num_threads(3)
    done: list[int] = []
    before = held()[1:]
    for _ in range(300):
        run_all(done.append, [(k,) for k in range(8)])
    assert held()[1:] == before
    assert sorted(done) == sorted([*range(8)] * 300)
