"""Peak memory of one call, in a process of its own: ``python -m torchbokeh.report.speed.memory JSON`` prints the bytes.

Allocators keep what they once had, and a process remembers only the most that it ever held. So each call gets a fresh
process, which runs the method on a tiny picture (to load and compile what it needs), makes the inputs, and then takes
the highest resident memory during the call less the resident memory before it. That counts everything, whichever
library allocates it: the output, scratch buffers, tables. Linux tells both numbers, other systems do not.
"""

import json
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import torch

from torchbokeh.report.speed.registry import every_method

_STATUS = Path("/proc/self/status")
_RESET = Path("/proc/self/clear_refs")


def is_known() -> bool:
    """Whether this system tells how much memory a process holds and held."""
    return _STATUS.exists()


def peak_memory(method: str, size: int, radius: float, *, backward: bool = False) -> int | None:
    """Bytes that a method needs beyond its inputs for one square picture.

    Args:
        method: the name of one of `torchbokeh.report.speed.registry.every_method`.
        size: side in px.
        radius: of the largest blur in px; the CoC is a ramp from minus this to this.
        backward: of a forward pass and the backward pass to image and CoC, together; else of the picture alone.

    Returns:
        Bytes, or None where the system does not tell.

    Raises:
        RuntimeError: the process failed; with the end of what it said.
    """
    if not is_known():
        return None
    asked = json.dumps([method, size, radius, backward, torch.get_num_threads()])
    # -P: the folder that the report is started in may hold a source tree.
    command = [sys.executable, "-P", "-m", __name__, asked]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"peak memory of {method}: {done.stderr.strip().splitlines()[-1]}")
    return int(done.stdout.split()[-1])


def resident(key: str) -> int:
    """Resident memory of this process in bytes: ``VmRSS`` now, ``VmHWM`` at most."""
    lines = dict(line.split(":", 1) for line in _STATUS.read_text().splitlines())
    return int(lines[key].split()[0]) * 1024


def _measure(method: str, size: int, radius: float, backward: bool, threads: int) -> int:
    torch.set_num_threads(threads)
    run = every_method()[method].run
    with torch.inference_mode(not backward):
        for side in (64, size):
            image = torch.rand(1, 3, side, side)
            ramp = torch.linspace(-radius, radius, side).expand(1, 1, side, side).contiguous()
            grad = torch.rand(1, 3, side, side) if backward else None
            if backward:
                image.requires_grad_()
                ramp.requires_grad_()
            if side == size:
                _forget_peak()
            before = resident("VmRSS")
            out = run(image, ramp)
            if backward:
                out.backward(grad)
    return max(resident("VmHWM") - before, out.nbytes)


def _forget_peak() -> None:
    """Start the peak anew from what is resident now.

    Where the kernel does not let us, the peak so far is that of the imports, which a megapixel goes beyond.
    """
    with suppress(OSError):
        _RESET.write_text("5")


if __name__ == "__main__":
    print(_measure(*json.loads(sys.argv[1])))
