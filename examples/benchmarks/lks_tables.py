"""Tables 2 and 3 of LKS with recipes of this package, and the picture of every cell at full size.

For `whirl`, `coins`, `rain` and `gears`: synthesis from the pinhole picture and from its layers, and reconstruction
from one sample per pixel, by dense scatters, filters, this package and a denoiser, against an accumulation buffer.
Prints one Markdown table and writes a sheet of pictures for each scene.

SSIM and PSNR are of ``clip(x, 0, 1) ** (1/2.2)``; a border as wide as the largest radius is left out. Medians.

    python examples/benchmarks/lks_tables.py [--size 256] [--radius 13] [--views 1024] [--repeat 3] [--out FOLDER]
"""

import argparse
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from torchbokeh.report.motion.experiments import like_lks, like_lks_table
from torchbokeh.report.settings import Settings
from torchbokeh.report.sheets import write_sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256, help="side of the pictures in px")
    parser.add_argument("--radius", type=float, default=13.0, help="largest CoC radius in px")
    parser.add_argument("--views", type=int, default=1024, help="of the truth")
    parser.add_argument("--repeat", type=int, default=3, help="timed runs of each method")
    parser.add_argument("--kinds", default="synthesis,reconstruction", help="one of them, or both")
    parser.add_argument("--out", type=Path, default=Path("out/motion"))
    parser.add_argument("--tiny", action="store_true", help="small, for tests")
    args = parser.parse_args()

    size, radius, views = (48, 4.0, 32) if args.tiny else (args.size, args.radius, args.views)
    settings = replace(Settings(), repeat=args.repeat, truth_size=size, truth_radius=radius, truth_views=views // 2)
    sheets: dict[str, list[tuple[str, Tensor]]] = {}

    def keep(scene: str, what: str, picture: Tensor) -> None:
        sheets.setdefault(scene, []).append((what, picture))

    rows = like_lks(settings, print, keep=keep, kinds=tuple(args.kinds.split(",")))
    print(like_lks_table(rows))
    args.out.mkdir(parents=True, exist_ok=True)
    for scene, pictures in sheets.items():
        shown = []
        for what, picture in pictures:
            kind, _, method = what.partition(": ")
            found = [r["ssim"] for r in rows if (r["scene"], r["kind"], r["method"]) == (scene, kind, method)]
            shown.append((f"{what}, SSIM {found[0]:.3f}" if found else what, picture))
        path = args.out / f"{scene}.png"
        write_sheet(path, shown)
        print(path)


if __name__ == "__main__":
    main()
