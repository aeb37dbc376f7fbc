"""A control loop at a fixed rate: the goal moves, an obstacle comes and goes, and every step is certified in time."""

import time

import numpy as np

import vgtm_qp as vq

RATE = 200.0
CYCLES = 400

problem = vq.load_problem("five_bay_two_cubes")
resolver = vq.Resolver(problem)
start = resolver.tip()[0]

# What is used for the first time takes longer, so it is used before the loop starts.
resolver.add_obstacle(vq.Sphere(name="first", center=(50.0, 0.0, 0.0), radius=0.2))
resolver.remove_obstacle("first")
for _ in range(20):
    resolver.step(position=start, dt=1.0 / RATE)
recording = vq.Recording(resolver, problem)

late = 0
computing = []
held = {}
begun = time.perf_counter()
for cycle in range(1, CYCLES + 1):
    clock = time.perf_counter()
    # A sensor sees a ball that flies in from the side and away again. Its velocity counts: steps and their proofs are
    # for where it will be.
    flight = 4 * cycle / CYCLES - 1.0
    if 0.0 <= flight < 2.0:
        center = np.array([1.05 - 0.3 * np.sin(0.5 * np.pi * flight), -0.2, 4.3])
        velocity = np.array([-0.3 * np.cos(0.5 * np.pi * flight) * 2.0 * np.pi * RATE / CYCLES, 0.0, 0.0])
        if "ball" not in [obstacle.name for obstacle in resolver.obstacles]:
            resolver.add_obstacle(vq.Sphere(name="ball", center=center, radius=0.2, velocity=velocity))
        resolver.move_obstacle("ball", center=center, velocity=velocity)
    elif flight == 2.0:
        resolver.remove_obstacle("ball")

    angle = 2.0 * np.pi * cycle / CYCLES
    goal = start + np.array([0.15, 0.1, 0.1]) * [np.sin(angle), 1.0 - np.cos(angle), np.cos(angle) - 1.0]
    step = resolver.step(position=goal, dt=1.0 / RATE)
    computing.append(time.perf_counter() - clock)

    # Here step.state.quantities go to the actuators, in the order of resolver.setup.arm.quantity_names.
    if step.status is not vq.StepStatus.REACHED:
        for name in step.blocked_by[:1]:
            held[name] = held.get(name, 0) + 1

    wait = begun + cycle / RATE - time.perf_counter()
    late += wait < 0.0
    time.sleep(max(0.0, wait))

gap = float(np.linalg.norm(resolver.tip()[0] - goal))
print(f"{CYCLES} cycles at {RATE:g} Hz, {late} late; median of a step {1000 * np.median(computing):.2f} ms")
print(f"held back by: {', '.join(f'{name} {count} times' for name, count in held.items()) or 'nothing'}")
print(f"the tip is {1000 * gap:.3f} mm from its goal")

# Each step is checked again, against the scene that it was made in.
certificate = vq.verify(recording.maneuver())
print(f"certified: {certificate.ok}; least clearance {1000 * certificate.clearance.value:.1f} mm")
print(*certificate.notes, sep="\n")
