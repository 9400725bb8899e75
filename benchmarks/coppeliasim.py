"""Control steps per second in CoppeliaSim, and the share of the time spent in its client.

One trial of the shipped policy, kinematic and with an engine, after a short one that compiles::

    python benchmarks/coppeliasim.py coppeliasim://localhost:23000 --seconds 20

Without a CoppeliaSim, `python -m tests.coppeliasim_server` is a stand-in for its protocol; it says
nothing about the speed of CoppeliaSim itself.
"""

import argparse
import json
import time

from equipoise.apps.coppeliasim.address import read_address
from equipoise.apps.coppeliasim.world import CoppeliaSimulation
from equipoise.control.policy import KernelPolicy, shipped_policy
from equipoise.model.random import TEST
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.worlds import run_trial, setup_of, simulate

POLICY = shipped_policy()


def measure(world: str, seconds: float) -> dict[str, float | str]:
    """Return the figures of a trial of some seconds in a world."""
    setup = setup_of(POLICY, world)
    simulation = CoppeliaSimulation(read_address(world), setup, seed=0, stream=TEST)
    loop, trial = simulation.loop(), simulation.draw(1).trial(0)
    policy, sim = KernelPolicy(POLICY.kernel), simulation.rig.sim
    run_trial(loop, policy, trial, 0.05)
    loop.reset(trial)
    calls, inside, began = sim.calls, sim.seconds, time.perf_counter()
    steps, cause, _ = run_trial(loop, policy, trial, seconds)
    wall = time.perf_counter() - began
    return {
        "world": world,
        "steps": steps,
        "cause": TRIAL_OUTCOMES[cause],
        "steps_per_second": steps / wall,
        "calls_per_step": (sim.calls - calls) / steps,
        "share_in_client": (sim.seconds - inside) / wall,
    }


def compiled_steps(seconds: float) -> float:
    """Return the steps per second of the same loop without CoppeliaSim, in Python on `ideal`."""
    simulation = simulate("ideal", setup_of(POLICY, "ideal"), seed=0, stream=TEST)
    loop, trial = simulation.loop(), simulation.draw(1).trial(0)
    run_trial(loop, KernelPolicy(POLICY.kernel), trial, 0.05)
    began = time.perf_counter()
    steps, _, _ = run_trial(loop, KernelPolicy(POLICY.kernel), trial, seconds)
    return steps / (time.perf_counter() - began)


def main() -> None:
    """Print a row for each kind of world."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("address", help="coppeliasim://HOST:PORT")
    parser.add_argument("--engine", default="mujoco")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a trial [s]")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    worlds = (given.address, f"{given.address}?engine={given.engine}")
    rows = [measure(world, given.seconds) for world in worlds]
    if given.json:
        print(json.dumps({"rows": rows, "ideal": compiled_steps(given.seconds)}))
        return
    for row in rows:
        print(
            f"{row['world']}: {row['steps']} steps, {row['cause']}; "
            f"{row['steps_per_second']:.0f} steps/s, {row['calls_per_step']:.1f} calls a step, "
            f"{100.0 * float(row['share_in_client']):.0f} % of the time in the client"
        )
    print(f"ideal, from Python: {compiled_steps(given.seconds):.0f} steps/s")


if __name__ == "__main__":
    main()
