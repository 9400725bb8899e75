"""Train a policy on an iiwa 14 and compare its survival with the baselines.

python examples/train_and_evaluate.py
"""

import equipoise as eq

pendulum = eq.shipped_pendulum()  # or the name of a file, "pendulum.json"
# A short training: without these settings it takes a minute, and the policy is better.
settings = eq.resolve(
    "robust",
    overrides=[
        "learning.episodes=5000",
        "selection.duration=20",
        "evaluation.duration=20",
    ],
)

policy = eq.train(pendulum, "iiwa14", settings, seed=1, workers=2)
chosen = policy.checkpoints[0]
print(
    f"trained {policy.episodes} episodes; the table after {chosen.episodes} is kept, "
    f"which survived {chosen.survived} of {chosen.trials} trials of the selection"
)
evaluation = eq.evaluate(policy, seed=1, workers=2)

for results in (evaluation.results, *evaluation.baselines):
    summary = results.summary()
    low, high = summary.interval
    print(
        f"{results.name:12} survived {summary.survived:3} of {summary.trials} trials "
        f"(95 %: {low:.3f} to {high:.3f}), median {summary.median:.1f} s, {summary.outcomes}"
    )

policy.save("policy.json")
