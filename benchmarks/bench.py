"""Steps per second, side by side: our training and trials and two peers, on one core, in one run.

- `training`: a training step of the paper's simulation, everything included: boxes, action, noise,
  CLIK on the full kinematics of the arm, pendulum, update of the table and its mirror image, starts
  of episodes.
- `training behind the actuator`: the same with transport delay, servo and drives, encoder,
  observer and prediction, which no peer has.
- `trials behind the actuator`: steps of trials of the shipped policy there.
- `trials on the twin`: the same with the arm and the pendulum in MuJoCo.
- `pinocchio`: the arm's part of that step alone, through Pinocchio from Python.
- `gymnasium`: a CartPole step, which has no arm, with a tabular update in Python.

A fraction of the core's peak is the floating-point operations of a step (`OPERATIONS`; random
numbers and the table are left out) times the steps per second, over the speed
of a loop of fused multiply-adds in the same rounds.

The peers are optimised as far as Python allows. Each does the same piece of work in
each round, and the rounds alternate, so that a processor that warms up or is shared slows all of
them alike. Compilation and imports come before the first round.

Last, trainings run side by side on several cores, and on all of them the vector environment, with
the whole arm behind the actuator, beside CartPole's, which Gymnasium computes with NumPy::

    python benchmarks/bench.py            # a table
    python benchmarks/bench.py --json     # steps_per_second and ratios by name, and more
"""

import argparse
import gc
import json
import os
import platform
import statistics
import sys
import time
from bisect import bisect
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import import_module
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.arm.arm import Arm
from equipoise.control.linear import lqr_gains
from equipoise.control.policy import shipped_policy
from equipoise.elementary import fma
from equipoise.executors import available_cores
from equipoise.jit import MAX_UNROLLED, kernel
from equipoise.learning.train import train
from equipoise.model.actuator import IDEAL_ACTUATOR, Actuator, shipped_actuator
from equipoise.model.pendulum import Pendulum
from equipoise.model.random import TEST
from equipoise.settings import Settings
from equipoise.simulation import setup_of, simulate

if TYPE_CHECKING:
    from rich.table import Table

Array = npt.NDArray[np.float64]
Work = Callable[[], int]
"""Does a piece of work, the same at each call, and returns how many steps it took."""

POOLS: Final = (
    "MKL_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""Variables that set the number of threads of a BLAS."""
OURS: Final = "training"
BEHIND: Final = "training behind the actuator"
TRIALS: Final = "trials behind the actuator"
TWIN: Final = "trials on the twin"
YARDSTICK: Final = "pinocchio"
"""Peer of which every ratio is."""
PACKAGES: Final = {TWIN: "mujoco", YARDSTICK: "pin"}
"""Package of each work, where it has another name."""
PEAK: Final = "peak"
"""The loop of fused multiply-adds."""
OPERATIONS: Final = {OURS: 1125.0, BEHIND: 4848.0, TRIALS: 4848.0}
"""Additions, multiplications, divisions and roots of a step with the iiwa7, counted in November
2026 by running the kernels on numbers that count; a multiply-add counts as two."""
PEAK_ADDS: Final = MAX_UNROLLED
"""Number of multiply-adds for each number that is loaded and stored, in an unrolled loop."""
PEAK_LANES: Final = 512
"""Number of independent numbers: their chains of multiply-adds overlap."""
TRIAL_COUNT: Final = 64
TRIAL_TIME: Final = 10.0
"""Length of a trial [s]."""
TWIN_TRIALS: Final = 2
LANES: Final = "equipoise.envs:equipoise/Balance-v0"
WIDTHS: Final = (16, 64, 1024)
"""Numbers of lanes of the vector environments."""
LANE_STEPS: Final = 65_536
"""Steps of all their lanes together in a round."""
ROUNDS: Final = 5
PEER_STEPS: Final = 32_000
"""Steps of a peer in a round: some tenths of a second."""


class Rate(NamedTuple):
    """Speed of one piece of work over the rounds [steps/s]."""

    median: float
    slowest: float
    fastest: float


class Benchmark(NamedTuple):
    """Results of a benchmark."""

    rates: dict[str, Rate]
    """Speed of each work, by name; ours is the first."""
    missing: dict[str, str]
    """Reason of each work that was left out, by name."""
    core: int | None
    """The core that all ran on; None where the system cannot say."""
    scaling: dict[int, float]
    """Speed of trainings side by side on a number of cores, relative to one core."""
    lanes: dict[int, tuple[float, float]]
    """Steps per second of our vector environment and of CartPole's, by the number of lanes."""

    @property
    def steps_per_second(self) -> dict[str, float]:
        """Median steps per second, by name."""
        return {name: rate.median for name, rate in self.rates.items() if name != PEAK}

    @property
    def ratios(self) -> dict[str, float]:
        """Speed relative to Pinocchio's loop, by name; empty without that."""
        speeds = self.steps_per_second
        peer = speeds.pop(YARDSTICK, None)
        return {} if peer is None else {name: speed / peer for name, speed in speeds.items()}

    @property
    def real_time(self) -> dict[str, float]:
        """Speed of ours relative to the arm, by name."""
        ours = (OURS, BEHIND, TRIALS, TWIN)
        return {n: r * paper.STEP for n, r in self.steps_per_second.items() if n in ours}

    @property
    def fractions(self) -> dict[str, float]:
        """Fraction of the core's peak, by name."""
        peak, speed = self.rates[PEAK].median, self.steps_per_second
        return {name: count * speed[name] / peak for name, count in OPERATIONS.items()}


def benchmark(pendulum: Pendulum, arm: Arm, settings: Settings) -> Benchmark:
    """Measure our training and the peers that are installed.

    Args:
        pendulum: Pendulum of the trainings.
        arm: The arm of ours and of Pinocchio.
        settings: Gains, noise and learning.
    """
    training = training_work(pendulum, arm, settings)
    prepare: dict[str, Callable[[], Work]] = {
        OURS: lambda: training,
        BEHIND: lambda: training_work(pendulum, arm, settings, shipped_actuator()),
        TRIALS: lambda: trials_work("model", TRIAL_COUNT),
        TWIN: lambda: trials_work("twin:nominal", TWIN_TRIALS),
        YARDSTICK: lambda: pinocchio_work(arm, settings),
        "gymnasium": cart_pole_work,
        PEAK: peak_work,
    }
    with _one_core() as core:
        rates, missing = race(prepare)
    _print_to_stderr("side by side")
    side_by_side = scaling(training, available_cores())
    return Benchmark(rates, missing, core, side_by_side, vector_environments(pendulum))


def race(prepare: dict[str, Callable[[], Work]]) -> tuple[dict[str, Rate], dict[str, str]]:
    """Let works run in turn, without garbage collection, as `timeit` does.

    Args:
        prepare: Prepares each work, by name; raises `ImportError` where a package is missing.

    Returns:
        The speed of each work, and why the others were left out, by name.
    """
    works: dict[str, Work] = {}
    missing: dict[str, str] = {}
    for name, prepared in prepare.items():
        _print_to_stderr(f"{name}: preparing")
        try:
            works[name] = prepared()
        except ImportError as error:
            missing[name] = (
                f"{error}; install it with: python -m pip install {PACKAGES.get(name, name)}"
            )
            continue
        works[name]()  # compiles what is compiled on the first call
    rates: dict[str, list[float]] = {name: [] for name in works}
    for number in range(1, ROUNDS + 1):
        for name, work in works.items():
            _print_to_stderr(f"{name}: round {number} of {ROUNDS}")
            with _no_collection():
                rates[name].append(speed_of(work))
    return {n: Rate(statistics.median(r), min(r), max(r)) for n, r in rates.items()}, missing


def speed_of(work: Work, threads: int = 1) -> float:
    """Return the speed of a work, in each of some threads [steps/s]."""
    if threads == 1:
        begin = time.perf_counter()
        steps = work()
        return steps / (time.perf_counter() - begin)
    with ThreadPoolExecutor(threads) as pool:
        begin = time.perf_counter()
        steps = sum(pool.map(lambda _: work(), range(threads)))
        return steps / (time.perf_counter() - begin)


def table(result: Benchmark) -> "Table":
    """Return the result as a table for a terminal."""
    from rich.table import Table

    where = _processor() if result.core is None else f"core {result.core}, {_processor()}"
    notes = [
        f"median of {ROUNDS} rounds, on {where}",
        f"ratio: to the {YARDSTICK} loop; real time: as a multiple, with steps of {paper.STEP:g} s",
    ]
    cores = ", ".join(f"{n}: {speed:.2f}" for n, speed in result.scaling.items())
    notes += [f"speed of trainings side by side, by the number of cores: {cores}"]
    notes += [
        f"vector environments of {n} lanes on all cores: ours {ours / 1e3:,.0f}, CartPole "
        f"{peer / 1e3:,.0f}, ratio {ours / peer:.2f}"
        for n, (ours, peer) in result.lanes.items()
    ]
    notes += [f"{name} is left out: {why}" for name, why in result.missing.items()]
    view = Table(title="Thousand steps per second", caption="\n".join(notes))
    view.add_column()
    for title in ("median", "slowest", "fastest", "ratio", "real time", "of peak"):
        view.add_column(title, justify="right", no_wrap=True)
    for name, rate in result.rates.items():
        if name == PEAK:
            continue
        cells = (
            (result.ratios, "{:.1f}"),
            (result.real_time, "{:,.0f}"),
            (result.fractions, "{:.0%}"),
        )
        others = (form.format(values[name]) if name in values else "" for values, form in cells)
        view.add_row(name, *(f"{speed / 1e3:,.0f}" for speed in rate), *others)
    return view


def training_work(
    pendulum: Pendulum, arm: Arm, settings: Settings, actuator: Actuator = IDEAL_ACTUATOR
) -> Work:
    """Return our work: one training, without the trials that select a policy."""
    selection = settings.selection.model_copy(update={"every": 0})
    alone = settings.model_copy(update={"selection": selection})
    return lambda: train(pendulum, arm, alone, actuator=actuator).steps


def trials_work(world: str, count: int) -> Work:
    """Return the work of trials of the shipped policy, on the arm that it was trained for.

    Raises:
        ImportError: The world needs a library that is not installed.
    """
    if world != "model":
        import_module("mujoco")
    policy = shipped_policy()
    setup = setup_of(policy, world, None, shipped_actuator())
    simulation = simulate(world, setup, seed=0, stream=TEST)

    def work() -> int:
        trials = simulation.draw(count)
        simulation.run(policy, trials, duration=TRIAL_TIME)
        return int(trials.steps.sum())

    return work


@kernel
def multiply_adds(numbers: Array, repeats: int) -> None:
    """Apply `PEAK_ADDS` multiply-adds to each number, `repeats` times."""
    for _ in range(repeats):
        for i in range(PEAK_LANES):
            x = numbers[i]
            for _ in range(PEAK_ADDS):
                x = fma(x, 0.999, 0.001)
            numbers[i] = x


def peak_work(repeats: int = 4000) -> Work:
    """Return a work of fused multiply-adds, which counts operations, two for each."""
    numbers = np.ones(PEAK_LANES)

    def work() -> int:
        multiply_adds(numbers, repeats)
        return 2 * PEAK_ADDS * PEAK_LANES * repeats

    return work


def scaling(work: Work, cores: int) -> dict[int, float]:
    """Return the speed of works side by side in threads, relative to one, by their number.

    Args:
        work: Releases Python's lock.
        cores: Largest number of threads; numbers are powers of two.
    """
    numbers = [2**i for i in range(cores.bit_length())]
    speeds: dict[int, list[float]] = {number: [] for number in numbers}
    for _ in range(ROUNDS):  # in turn, and the median of each
        for number in numbers:
            speeds[number].append(speed_of(work, number))
    alone = statistics.median(speeds[1])
    return {number: statistics.median(speeds[number]) / alone for number in numbers}


def pinocchio_work(arm: Arm, settings: Settings, steps: int = PEER_STEPS) -> Work:
    """Return the work of Pinocchio: the arm moves to and fro, and ends where it began."""
    loop = PinocchioLoop(arm, settings, paper.STEP)
    cycle = _to_and_fro()
    commands = np.tile(cycle, -(-steps // cycle.size)).tolist()

    def work() -> int:
        loop.reset()
        return loop.run(commands)

    return work


def _to_and_fro(ticks: int = 10) -> Array:
    """Return a command per step: with each size of action, there and back to where it began."""
    sizes = [u for u in paper.ACTIONS if u > 0.0]
    return np.concatenate([np.repeat((u, -u, u), (ticks, 2 * ticks, ticks)) for u in sizes])


class PinocchioLoop:
    """The arm's part of a control step, equation (3) and what follows it, through Pinocchio.

    As a user of Python writes it who wants it fast: arrays are made once and changed in place,
    names are local to the loop, all limits are one comparison.
    """

    def __init__(self, arm: Arm, settings: Settings, h: float, seed: int = 0) -> None:
        """Build the model from the numbers of the arm.

        Raises:
            ImportError: Pinocchio is not installed.
        """
        self.pin = pin = import_module("pinocchio")
        self.model, self.frame, self.pivot = _model(pin, arm)
        self.data = self.model.createData()
        self.h, self.clik = h, settings.clik
        plant = settings.plant
        self.sigma = np.repeat((plant.position_error_sigma, plant.orientation_error_sigma), 3)
        self.rng = np.random.default_rng(seed)
        joints = arm.free_joints
        bounds = np.array([(j.velocity, j.acceleration) for j in joints]).T.ravel()
        self.lower = np.concatenate(([j.lower for j in joints], -bounds))
        self.upper = np.concatenate(([j.upper for j in joints], bounds))
        self.home = arm.home_free
        self.motion = np.zeros(18)
        """q, dq, ddq of the free joints in one array."""
        self.reset()

    @property
    def q(self) -> Array:
        """Free joints [rad], shape (6,)."""
        return self.motion[:6]

    def reset(self) -> None:
        """Return home, at rest."""
        self.motion[:] = 0.0
        self.q[:] = self.home
        self.pin.forwardKinematics(self.model, self.data, self.home)
        place = self.pin.updateFramePlacement(self.model, self.data, self.frame)
        self.position, self.rotation = place.translation.copy(), place.rotation.copy()
        self.reference_twist = np.zeros(6)
        self.tracked = 0.0
        self.within = True

    def run(self, commands: Sequence[float]) -> int:
        """Take a step for each commanded acceleration u [m/s^2]; return how many it took.

        Afterwards `motion` and `tracked` hold the last step, `within` whether all kept the limits.
        """
        pin, model, data, frame, h = self.pin, self.model, self.data, self.frame, self.h
        aligned, pivot, velocity = pin.LOCAL_WORLD_ALIGNED, self.pivot, pin.getFrameVelocity
        K_p, K_d, sigma, normal = self.clik.K_p, self.clik.K_d, self.sigma, self.rng.standard_normal
        motion, lower, upper = self.motion, self.lower, self.upper
        q, dq, ddq = motion[:6], motion[6:12], motion[12:]
        position, rotation, twist_r = self.position, self.rotation, self.reference_twist
        e, Gamma, zero = np.zeros(6), np.zeros(6), np.zeros(6)
        within, tracked = self.within, self.tracked

        pin.forwardKinematics(model, data, q, dq, zero)
        jacobian = pin.computeFrameJacobian(model, data, q, frame, aligned)
        twist = jacobian @ dq
        v = velocity(model, data, pivot, aligned).linear[0]
        for u in commands:
            place = pin.updateFramePlacement(model, data, frame)
            bias = pin.getFrameClassicalAcceleration(model, data, frame, aligned).vector
            e[:3] = position - place.translation
            e[3:] = pin.log3(rotation @ place.rotation.T)
            e += sigma * normal(6)
            Gamma[0] = u
            ddq[:] = np.linalg.solve(jacobian, Gamma + K_d * (twist_r - twist) + K_p * e - bias)
            q += h * dq + (0.5 * h * h) * ddq
            dq += h * ddq
            within = within and bool(((lower <= motion) & (motion <= upper)).all())
            position[0] += h * twist_r[0] + 0.5 * u * h * h
            twist_r[0] += u * h

            v_before = v
            pin.forwardKinematics(model, data, q, dq, zero)
            jacobian = pin.computeFrameJacobian(model, data, q, frame, aligned)
            twist = jacobian @ dq
            v = velocity(model, data, pivot, aligned).linear[0]
            tracked = (v - v_before) / h
        self.within, self.tracked = within, float(tracked)
        return len(commands)


def _model(pin: Any, arm: Arm) -> tuple[Any, int, int]:
    """Return a Pinocchio model of the free joints, and the numbers of its flange and its pivot."""
    along = {
        (1.0, 0.0, 0.0): pin.JointModelRX,
        (0.0, 1.0, 0.0): pin.JointModelRY,
        (0.0, 0.0, 1.0): pin.JointModelRZ,
    }
    model, parent = pin.Model(), 0
    place = pin.SE3.Identity()
    for number, joint in enumerate(arm.joints, start=1):
        place = place * pin.SE3(pin.rpy.rpyToMatrix(*joint.rpy), np.array(joint.xyz))
        axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
        if number == arm.held_joint:
            place = place * pin.SE3(pin.exp3(arm.held_angle * axis), np.zeros(3))
            continue
        known = along.get(joint.axis)
        turn = pin.JointModelRevoluteUnaligned(axis) if known is None else known()
        parent = model.addJoint(parent, turn, place, joint.name)
        place = pin.SE3.Identity()
    place = place * pin.SE3(pin.rpy.rpyToMatrix(*arm.flange_rpy), np.array(arm.flange_xyz))
    flange = model.addFrame(pin.Frame("flange", parent, place, pin.FrameType.OP_FRAME))
    place = place * pin.SE3(np.eye(3), np.array(arm.pivot))
    return model, flange, model.addFrame(pin.Frame("pivot", parent, place, pin.FrameType.OP_FRAME))


# Grid of Barto, Sutton and Anderson, "Neuronlike adaptive elements that can solve difficult
# learning control problems", 1983, section V: x [m], x_dot [m/s], angle [rad], its rate [rad/s].
CART_POLE_EDGES: Final = (
    (-0.8, 0.8),
    (-0.5, 0.5),
    (radians(-6.0), radians(-1.0), 0.0, radians(1.0), radians(6.0)),
    (radians(-50.0), radians(50.0)),
)


def cart_pole_work(steps: int = PEER_STEPS) -> Work:
    """Return the work of Gymnasium: a tabular Q-learning of CartPole-v1 from its beginning.

    Raises:
        ImportError: Gymnasium is not installed.
    """
    gymnasium = import_module("gymnasium")
    env = gymnasium.make("CartPole-v1")
    xs, x_dots, phis, phi_dots = CART_POLE_EDGES
    alpha, gamma, epsilon = 0.1, 0.99, 0.05

    def box(observation: Array) -> tuple[int, int, int, int]:
        x, x_dot, phi, phi_dot = observation.tolist()
        return bisect(xs, x), bisect(x_dots, x_dot), bisect(phis, phi), bisect(phi_dots, phi_dot)

    def work() -> int:
        rng = np.random.default_rng(0)
        Q = np.zeros((*(len(edges) + 1 for edges in CART_POLE_EDGES), 2))
        s = box(env.reset(seed=0)[0])
        for _ in range(steps):
            a = int(rng.integers(2)) if rng.random() < epsilon else int(Q[s].argmax())
            observation, reward, terminated, truncated, _ = env.step(a)
            s_next = box(observation)
            target = reward if terminated else reward + gamma * Q[s_next].max()
            Q[s][a] += alpha * (target - Q[s][a])
            s = box(env.reset()[0]) if terminated or truncated else s_next
        return steps

    return work


def vector_environments(pendulum: Pendulum) -> dict[int, tuple[float, float]]:
    """Return steps per second of our vector environment and of CartPole's, by number of lanes.

    The LQR balances the arms, and a PD law the carts, so that few episodes fail.
    """
    gains = np.array(lqr_gains(pendulum.parameters(), paper.STEP))
    peers: dict[str, Callable[[Array], Any]] = {
        LANES: lambda seen: (seen @ gains)[:, None],
        "CartPole-v1": lambda seen: (seen[:, 2] + seen[:, 3] > 0.0).astype(np.int64),
    }
    speeds: dict[int, tuple[float, float]] = {}
    for width in WIDTHS:
        with ExitStack() as stack:
            works = {n: partial(vector_work, n, act, width, stack) for n, act in peers.items()}
            rates, missing = race(works)
        if not missing:
            speeds[width] = rates[LANES].median, rates["CartPole-v1"].median
    return speeds


def vector_work(name: str, act: Callable[[Array], Any], width: int, stack: ExitStack) -> Work:
    """Return the work of a vector environment: steps of its lanes, from where they were.

    Args:
        name: Name of the environment.
        act: Returns the actions of the lanes for their observations.
        width: Number of lanes.
        stack: Closes the environment.

    Raises:
        ImportError: Gymnasium is not installed.
    """
    envs = import_module("gymnasium").make_vec(name, width, "vector_entry_point")
    stack.callback(envs.close)
    seen, _ = envs.reset(seed=0)

    def work() -> int:
        nonlocal seen
        for _ in range(LANE_STEPS // width):
            seen, *_ = envs.step(act(seen))
        return LANE_STEPS // width * width

    return work


def _print_to_stderr(text: str) -> None:
    print(text, file=sys.stderr)


@contextmanager
def _one_core() -> Generator[int | None]:
    """Keep this thread, and those that it starts, on one core, where the system can do that.

    Systems of 6 equations are far below the size from which a BLAS calls its threads.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    allowed = os.sched_getaffinity(0)
    core = max(allowed)  # the first ones serve most interrupts
    os.sched_setaffinity(0, {core})
    try:
        yield core
    finally:
        os.sched_setaffinity(0, allowed)


@contextmanager
def _no_collection() -> Generator[None]:
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(names), "") or platform.processor() or platform.machine()


def main() -> None:
    """Measure, and print a table or one JSON object."""
    from rich.console import Console

    from equipoise.cli.options import read_arm
    from equipoise.errors import EquipoiseError
    from equipoise.model.pendulum import shipped_pendulum

    parser = argparse.ArgumentParser(description="Steps per second beside Pinocchio and Gymnasium.")
    parser.add_argument("--arm", default="iiwa7", help="iiwa7, iiwa14, a URDF or a rig.toml")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    args = parser.parse_args()
    try:
        arm = read_arm(args.arm)
    except EquipoiseError as error:
        parser.error(str(error))
    _print_to_stderr("Measuring on one core, in alternating rounds, for about half a minute")
    result = benchmark(shipped_pendulum(), arm, Settings())
    if args.json:
        print(json.dumps(summary(result)))
    else:
        Console().print(table(result))


def summary(result: Benchmark) -> dict[str, object]:
    """Return the result as the object of `--json`."""
    return {
        "steps_per_second": result.steps_per_second,
        "ratios": result.ratios,
        "real_time": result.real_time,
        "operations": OPERATIONS,
        "share_of_peak": result.fractions,
        "scaling": result.scaling,
        "lanes": result.lanes,
        "missing": result.missing,
        "processor": _processor(),
    }


if __name__ == "__main__":
    # BLAS reads these when NumPy is loaded: begin again with them set.
    if any(os.environ.get(pool) != "1" for pool in POOLS):
        os.execve(sys.executable, sys.orig_argv, os.environ | dict.fromkeys(POOLS, "1"))
    main()
