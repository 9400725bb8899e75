"""Identify, train, evaluate and deploy, with the defaults; it needs a recording, swing.csv.

python examples/pipeline.py
"""

import equipoise as eq

pendulum = eq.identify("swing.csv")
policy = eq.train(pendulum, "iiwa7")
print(eq.evaluate(policy, world="twin:nominal"))
run = eq.simulate_run(policy, world="twin:nominal")
print(run)
policy.save("mine.json")
run.save("mine.mcap")
