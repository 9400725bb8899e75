"""Draw the pictures of README and documents with the shipped policy: `make pictures`.

balancing.webp shows a run of `equipoise deploy --start hanging` on the digital twin, as
`equipoise log export RUN --video balancing.webp --to 3` films it, and swing-up.png its
swing-up; survival.png the policy and the baselines on the training plant. `make results` draws the
figures of the experiments. The folder gallery has the pictures that examples write, and one of the
wind of bring-a-world.md.
"""

import contextlib
import re
import runpy
import tempfile
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from PIL import Image

import equipoise as eq
from equipoise.film import write_film
from equipoise.report.figures import survival, swing_up
from equipoise.report.style import render
from equipoise.settings import HANGING, changed

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PICTURED = ("lqr", "mpc", "delay_of_a_log", "swing_up", "arm_from_a_urdf")
"""Examples that write a picture of their name."""
WIDTH = 480
"""Width of a picture in the gallery [px]."""


def main() -> None:
    """Draw the pictures."""
    policy = eq.shipped_policy()
    hanging = changed(policy.settings, {"evaluation.start": HANGING})
    run = eq.simulate_run(policy, world="twin:nominal", duration=10.0, settings=hanging)
    write_film(run, HERE / "balancing.webp", end=3.0)
    (HERE / "swing-up.png").write_bytes(render(swing_up(run), "png"))
    (HERE / "survival.png").write_bytes(render(survival(eq.evaluate(policy)), "png"))
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name in PICTURED:
            runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
        draw_wind()
        for path in Path().glob("*.png"):
            image = Image.open(path).convert("RGB")
            image.thumbnail((WIDTH, WIDTH))
            image.save(HERE / "gallery" / f"{path.stem}.webp", quality=80, method=6)


def draw_wind() -> None:
    """Draw five runs in the world of bring-a-world.md, as wind.png in the current folder."""
    page = (ROOT / "docs" / "how-to" / "bring-a-world.md").read_text()
    (world,) = re.findall(r"```python\n(# own_world\.py\n.*?)```", page, re.DOTALL)
    Path("own_world.py").write_text(world)
    figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
    for seed in range(5):
        run = eq.simulate_run(world="own_world:Windy", duration=10.0, seed=seed)
        axes.plot(run.time, np.degrees(run.ticks.phi), label=f"seed {seed}: {run.outcome}")
    axes.set(xlabel="time [s]", ylabel="pendulum φ [deg]")
    axes.legend(ncols=2)
    figure.savefig("wind.png")


if __name__ == "__main__":
    main()
