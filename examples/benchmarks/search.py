"""Look for scenes that break a law of the library, as long as one likes: the worst of each, as code that makes it.

Laws and scenes are those of ``tests/properties``, so run it from a clone: ``search.py --minutes 30 --seed 1``. A line
that it prints makes the same scene in ``tests/properties/test_laws.py``.
"""

import argparse
import importlib.util
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

PROPERTIES = Path(__file__).resolve().parents[2] / "tests" / "properties"


def package() -> tuple[Any, Any, Any]:
    """The modules ``law``, ``laws`` and ``scenes`` of ``tests/properties``."""
    place = [str(PROPERTIES)]
    spec = importlib.util.spec_from_file_location(
        "properties", PROPERTIES / "__init__.py", submodule_search_locations=place
    )
    assert spec is not None
    assert spec.loader is not None
    sys.modules["properties"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["properties"])
    from properties import law, laws, scenes

    return law, laws, scenes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0, help="another one tries other scenes")
    parser.add_argument("--laws", nargs="*", default=[], help="names, or parts of them; all without it")
    parser.add_argument("--largest", type=int, default=130, metavar="PX", help="no side is longer")
    parser.add_argument("--tiny", action="store_true", help="two small scenes of each law, to see that it runs")
    args = parser.parse_args()
    law, laws, scenes = package()
    chosen = [one for one in laws.LAWS if not args.laws or any(part in one.name for part in args.laws)]
    if not chosen:
        parser.error(f"--laws: expected some of {', '.join(one.name for one in laws.LAWS)}, got {' '.join(args.laws)}")

    torch.set_num_threads(1)  # scenes are small
    rng, worst, counts = np.random.default_rng(args.seed), {}, {one.name: [0, 0, 0.0] for one in chosen}
    sides = scenes.SIDES[:8] if args.tiny else tuple(n for n in scenes.LARGE if n <= max(args.largest, 1))
    start = time.monotonic()
    while time.monotonic() - start < (0 if args.tiny else 60 * args.minutes) or min(c[0] for c in counts.values()) < 2:
        # Each law gets about the same time, so that a slow one does not hold up the others.
        one = min(chosen, key=lambda one: (counts[one.name][0] >= 2, counts[one.name][2]))
        count, began, scene = counts[one.name], time.monotonic(), scenes.draw(rng, sides)
        try:
            found = law.tried(one, scene)
        except Exception as error:
            print(f"{one.name}: {type(error).__name__} ({error}) at {one.suit(scene)!r}", flush=True)
            found = law.Found(one.suit(scene), float("inf"), 0.0)
        count[2] += time.monotonic() - began
        if found is None:
            continue
        count[0] += 1
        count[1] += found.share > 1
        if one.name not in worst or found.share > worst[one.name].share:
            worst[one.name] = found
            if found.share > one.most:
                print(f"{one.name}: {found.value:.3g}, bound {found.bound:.3g}: {found.scene!r}", flush=True)

    print("\n| law | scenes | broken | worst | its bound | code that makes it |\n| --- | --- | --- | --- | --- | --- |")
    for one in chosen:
        found, (tries, broken, _) = worst[one.name], counts[one.name]
        print(f"| {one.name} | {tries} | {broken} | {found.value:.2g} | {found.bound:.2g} | `{found.scene!r}` |")


if __name__ == "__main__":
    main()
