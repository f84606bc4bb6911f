"""Export a lens blur to ONNX, and pull focus with numpy and onnxruntime alone.

The file is written by torch. It is then run in a process of its own, which never loads torch: one image, one depth map,
and a row of pictures with the focus going from near to far, since focus distance and f-number are inputs of the file.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image


def export(folder: Path, size: tuple[int, int], quality: str) -> None:
    """Write ``blur.onnx``, and ``scene.npz`` with an image and its depth."""
    import torchbokeh as tb

    width, height = size
    scene, camera = tb.scenes.ramp(seed=3, size=(height, width), blur=height / 24)
    seen = scene.render(camera)
    image, depth = seen["image"][None, :3], seen["depth"][None]
    blur = tb.LensBlur(camera.lens, quality=quality)
    start = time.perf_counter()
    path = tb.export_onnx(blur, folder / "blur.onnx", image, depth)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB, {time.perf_counter() - start:.1f} s")
    aperture = {"focus": camera.lens.focus_distance.item(), "f_number": camera.lens.f_number.item()}
    np.savez(folder / "scene.npz", image=image.numpy(), depth=depth.numpy(), **aperture)


def run(folder: Path) -> None:
    """Blur the scene with what the file says."""
    import onnxruntime

    session = onnxruntime.InferenceSession(folder / "blur.onnx", providers=["CPUExecutionProvider"])
    with np.load(folder / "scene.npz") as scene:
        given = {"image": scene["image"], "depth": scene["depth"], "f_number": np.array(scene["f_number"], np.float32)}
        focus = float(scene["focus"])
    pictures = []
    for distance in (0.7 * focus, focus, 1.6 * focus):
        given["focus_distance"] = np.array(distance, np.float32)
        start = time.perf_counter()
        (blurred,) = session.run(None, given)
        print(f"focus at {distance:.2f} m: {time.perf_counter() - start:.2f} s")
        pictures.append(blurred[0].transpose(1, 2, 0))
    shown = np.concatenate(pictures, 1).clip(0, 1) ** (1 / 2.2)
    Image.fromarray((255 * shown).round().astype(np.uint8)).save(folder / "focus.png")
    print(folder / "focus.png")
    if "torch" in sys.modules:
        raise RuntimeError("torch was loaded")


def main() -> None:
    """Export, then run in another process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/export_onnx"), metavar="DIR")
    parser.add_argument("--quality", default="balanced", help="exact, high, balanced or fast (default balanced)")
    parser.add_argument("--run", action="store_true", help="only run what was exported to --out before")
    parser.add_argument("--tiny", action="store_true", help="small, for tests")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.run:
        run(args.out)
        return
    export(args.out, (48, 36) if args.tiny else (640, 480), args.quality)
    subprocess.run([sys.executable, __file__, "--run", "--out", str(args.out)], check=True)


if __name__ == "__main__":
    main()
