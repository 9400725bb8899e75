"""Sections of the report up to the trained policy: verdict, task, comparison, swing, training."""

from collections.abc import Iterator
from importlib import resources

import numpy as np

from equipoise import paper
from equipoise.apps.report import markup as html
from equipoise.apps.report.comparison import comparison
from equipoise.apps.report.pictures.film import SECONDS, Animation
from equipoise.control.policy import TabularPolicy
from equipoise.model.worlds import MODEL
from equipoise.reproduction.results import Results, verdict
from equipoise.worlds.evaluation import TrialResults
from equipoise.worlds.formatting import percent, plus_minus


def sections_training(
    results: Results, picture: html.Picture, animation: Animation | html.Missing
) -> Iterator[html.Part]:
    """Yield the sections from the verdict to the training."""
    yield _verdict(results)
    yield _task(results, animation)
    head = "", "section", "the paper", "this reproduction"
    yield html.part("paper", "Comparison with the paper", html.table(head, comparison(results)))
    yield _swing(results, picture)
    yield _training(results, picture)


def _verdict(results: Results) -> html.Part:
    run, evaluation, plant = results.run, results.evaluation, "the training plant"
    world, limit = run.conditions.world, f"{run.conditions.duration:g} s"
    where = plant if world == MODEL else f"the digital twin {world}"
    recorded = f"balancing time of the recorded run, of at most {limit}, on {where}"
    tiles = [
        _survival_tile(evaluation.results, evaluation.duration, plant),
        (f"{run.lasted:.3g} s", recorded),
        (f"{paper.SECONDS_BALANCED:g} s", "balancing time of the paper's one run on the real arm"),
    ]
    if world != MODEL:
        tiles[:2] = tiles[1::-1]  # the twin, which is closer to the paper's robot, comes first
    if on_twin := results.twin_evaluation:
        twin = f"the digital twin {on_twin.world}"
        tiles.insert(0, _survival_tile(on_twin.results, on_twin.duration, twin))
    lines = html.bullets(verdict(results), "ol", "verdict")
    return html.part("verdict", "Verdict", html.tiles(*tiles), lines)


def _survival_tile(trials: TrialResults, duration: float, where: str) -> tuple[str, str]:
    summary = trials.summary()
    interval = f"95 % interval of the survival rate {' to '.join(map(percent, summary.interval))}"
    stood = f"trials stood {duration:g} s on {where}; {interval}"
    return f"{summary.survived} of {summary.trials}", stood


def _task(results: Results, animation: Animation | html.Missing) -> html.Part:
    growth_time = 1.0 / np.sqrt(results.pendulum.w2.value)
    sketch = (
        resources.files("equipoise.apps.report").joinpath("sketch.svg").read_text(encoding="utf-8")
    )
    stage = (
        "the training plant"
        if results.run.conditions.world == MODEL
        else "a digital twin of the robot (the paper: on the real robot)"
    )
    added = (
        "A real robot adds two effects to the paper's simulation: a command takes effect with a "
        "delay, during which the pendulum keeps falling, and the encoder's zero may be wrong. "
        "Therefore a controller between sensor and table estimates angle, angular velocity and "
        "zero error, and predicts the state when the command takes effect: the input of the table. "
        "Training uses the same controller and an arm with the lag identified on the twin."
    )
    return html.part(
        "what",
        "Task and method",
        html.paragraph(
            "A pendulum on the flange of a robot arm turns freely on its pivot. The arm keeps it "
            "upright by moving the flange along one horizontal line. Without control, the lean "
            f"grows almost threefold every {growth_time:.3f} s; the track ends {paper.X_LIMIT:g} m "
            "to either side."
        ),
        html.film(
            animation,
            f"The first {min(results.run.lasted, SECONDS):g} s of the recorded run, in real time. "
            f"Posts at x = ±{paper.X_LIMIT:g} m, marks every 0.1 m; the shadow of the pivot shows "
            "x. The arrow is the commanded acceleration u.",
            "Animation of the arm that balances the pendulum between the ends of the track",
        ),
        f"<figure>{sketch}<figcaption>The state is s = (x, dx/dt, φ, dφ/dt): position and velocity "
        "of the flange, angle and angular velocity of the pendulum. The command is the "
        f"acceleration u. A trial fails when |φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches "
        f"{paper.X_LIMIT:g} m.</figcaption></figure>\n",
        html.paragraph(
            "The paper solves this task with tabular Q-learning. The state space is divided into "
            f"{len(results.policy.Q)} boxes. For each box the table holds the value of each of "
            f"{len(paper.ACTIONS)} accelerations, learned by trial and error in simulation. A "
            "hundred times a second the policy selects the best acceleration of the current box."
        ),
        "" if results.policy.settings.plant.ideal else html.paragraph(added),
        html.paragraph(
            "This page follows the same steps: a free swing identifies the pendulum, a simulated "
            "arm learns with it, the policy is tested on pendulums with other parameters, and one "
            f"run is recorded on {stage}."
        ),
    )


def _swing(results: Results, picture: html.Picture) -> html.Part:
    fit = results.pendulum.fit
    source = (
        "No recording was given. This one is simulated, with encoder quantisation, vibration and a "
        "hand that holds the pendulum first; the last column holds the simulated values."
        if results.record.simulated
        else f"The recording is `{results.record.swing}`."
    )
    return html.part(
        "swing",
        "Identification from a free swing",
        html.paragraph(
            "The hanging pendulum is lifted and released; an encoder on its spindle records the "
            "angle θ from hanging. It follows I θ'' + b θ' + m g l sin θ = 0 (the paper's equation "
            "8). The fit gives w2 = m g l / I and c = b / I, and with gravity the coupling k = "
            f"m l / I. The controller needs no other parameter. {source}"
        ),
        picture(
            "figure-2-free-swing",
            "The paper's figure 2, with the residual. The grey part, with a hand on the pendulum, "
            "was detected and excluded.",
            "Recorded angle of the swinging pendulum with the fitted curve on it, and the residual",
        ),
        _estimates(results),
        *(html.paragraph(warning, "note") for warning in (fit.warnings if fit else ())),
    )


def _estimates(results: Results) -> str:
    pendulum, truth = results.pendulum, {}
    if swing := results.record.simulated:
        w2 = (2.0 * np.pi / swing.period) ** 2
        truth = {"w2": w2, "k": w2 / pendulum.g, "c": swing.c}
    rows = [
        ("w2 = m g l / I", "1/s²", pendulum.w2, truth.get("w2")),
        ("k = m l / I", "1/m", pendulum.k, truth.get("k")),
        ("c = b / I", "1/s", pendulum.c, truth.get("c")),
    ]
    if pendulum.friction_model != "viscous":
        rows.append(("Coulomb friction / I", "1/s²", pendulum.coulomb, None))
    if pendulum.friction_model == "quadratic":
        rows.append(("quadratic drag / I", "1/rad", pendulum.drag, None))
    if pendulum.inertia and pendulum.friction:
        rows.append(("I", "kg m²", pendulum.inertia, None))
        rows.append(("b", "N m s", pendulum.friction, None))
    head = [
        "",
        "unit",
        "identified, ± half of the 95 % interval",
        *(["simulated"] if truth else []),
    ]
    cells = [
        [name, unit, plus_minus(e.value, e.interval), *([f"{true:.6g}"] if true else [])]
        for name, unit, e, true in rows
    ]
    return html.table(head, cells, numbers=2 if truth else 1)


def _actuator(policy: TabularPolicy) -> str:
    actuator = policy.actuator
    if policy.settings.plant.ideal:
        ideal = "The arm follows its commands at once, and the state is known without a sensor"
        return f"{ideal}, as in the paper's simulation."
    lags = [1e3 * lag.value for lag in actuator.lags]
    law = "through the server's shaping law, " if actuator.kind == "kst" else ""
    return (
        f"The arm follows its setpoints after {1e3 * actuator.delay.value:.1f} ms, {law}with lags "
        f"of {min(lags):.1f} to {max(lags):.1f} ms in its joints, estimated from a log of the "
        "moving arm by `equipoise identify`, never from the settings of the twin. Each episode has "
        "random errors of these numbers and of the encoder's zero: the policy learns with an "
        "imperfect estimator and prediction."
    )


def _training(results: Results, picture: html.Picture) -> html.Part:
    policy, s = results.policy, results.policy.settings
    start = s.learning.start_x
    where = f"within {start:g} m of the middle" if start else "in the middle"
    selection = "The policy is the table after the last episode; no selection took place."
    if policy.checkpoints:
        chosen, rule = policy.checkpoints[0], s.selection
        candidate = "current table" if rule.averaging == 1.0 else "running average of the table"
        selection = (
            f"A later table is not always better. So the greedy policies of the {candidate} in the "
            f"last {100.0 * rule.late:g} % of the episodes race: they run the same trials of "
            f"{rule.duration:g} s, on plants with {rule.spread:g} times the variation of the "
            f"training, and those that are worse leave. Of {len(policy.checkpoints)} candidates, "
            f"the table after episode {chosen.episodes:,} won: it lasted {chosen.survived} of "
            f"{chosen.trials} trials."
        )
    if policy.test is not None:
        selection += f" In its test, whose trials chose nothing, {policy.test.text}."
    if policy.shortfall:
        selection += " The policy misses the target of its training."
    return html.part(
        "training",
        "Training",
        html.paragraph(
            f"An episode starts with the flange {where} and the pendulum leaning up to "
            f"{np.rad2deg(s.learning.start_phi):.3g}°. Every {policy.h:g} s the learner selects an "
            "acceleration, closed-loop inverse kinematics converts it to joint motion (the paper's "
            "equation 3), and the actual flange motion drives the pendulum (equation 7"
            f"{'' if s.plant.linearised else ', with its sines'}). The episode ends with a failure "
            f"or after {s.learning.episode_duration:g} s. A failure costs "
            f"{-s.learning.reward_failure:g}, all else nothing; equation 1 propagates that cost to "
            "earlier choices. I and b vary per episode; each step adds noise to the pose error."
        ),
        html.paragraph(_actuator(policy)),
        html.paragraph(selection),
        picture(
            "learning-curve",
            "Above: duration of the training episodes, with exploration. Below: the candidates of "
            "the selection, larger with more trials. One changed action can change the share "
            "drastically: therefore the best table is kept, not the last.",
            "Mean duration of the training episodes and survival of the candidates",
        ),
    )
