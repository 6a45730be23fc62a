"""Where the time of a physics tick goes: its pieces, compiled one by one for a batch, on one core.

    python benchmarks/tick_profile.py

A piece on its own reads and writes its arguments, which the whole tick keeps in registers and cache: the pieces add up
to more than the tick. The last line relates the whole tick's floating-point operations, as XLA counts them, to what
the core does in a matrix product.
"""

import argparse
import json
from typing import Any

import common

CORE = common.use_one_core()  # before JAX is imported

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

from jaxbiped import planner, robot, runtime, sim  # noqa: E402
from jaxbiped.adapt import Controller  # noqa: E402
from jaxbiped.sim import ground, mjx_adapter, plant, statistics  # noqa: E402
from jaxbiped.sim.physics.compliant import seen  # noqa: E402
from jaxbiped.sim.tick import servo_reference  # noqa: E402

DT = 5e-4
REPEATS = 9


def pieces(name: str, batch: int) -> dict[str, tuple[Any, tuple]]:
    """Functions of one lane and their batched arguments, by name; `tick` is all of them together."""
    params = robot.on_device(robot.load(name))
    gait = planner.own_gait(params, 4)
    options = sim.Options(dt=DT)
    simulation = sim.prepare(params, Controller(gait), options)
    table = simulation.torque
    world = plant.make_plant(params, simulation.model, sim.Scenario.flat())
    qpos = jnp.concatenate([jnp.array([0.0, 0, 0.5, 1, 0, 0, 0]), params.joint_range.mean(-1).reshape(-1)])
    many_qpos = qpos + 1e-3 * jax.random.normal(jax.random.key(0), (batch, qpos.size))
    many_qvel = 1e-2 * jax.random.normal(jax.random.key(1), (batch, 18))
    times = jnp.linspace(0.5, 1.5, batch)

    def move(q: Any, v: Any, t: Any) -> Any:
        return plant.body_motion(world, q, v, t, DT)

    def touch(body: Any) -> Any:
        return ground.contact(params, world.scenario.ground, world.scenario.terrain, body, None, DT)

    def forces(body: Any, contact: Any) -> Any:
        return plant.contact_force(body, contact), ground.damping_matrix(body, contact)

    def accelerate(body: Any, drag: Any, force: Any) -> Any:
        matrix = jax.tree.map(lambda m, d: m + DT * d, mjx_adapter.blocks(body.mass_matrix), drag)
        return mjx_adapter.solve(matrix, force - body.bias)

    def refer(t: Any) -> Any:
        return servo_reference(params, planner.at(gait, t), table)

    def advance(q: Any, v: Any) -> Any:
        return mjx_adapter.integrate(world.model, q, v, DT)

    def tick(q: Any, v: Any, t: Any) -> Any:
        body = move(q, v, t)
        contact = touch(body)
        force, drag = forces(body, contact)
        reference, _ = refer(t)
        _, torque, _ = plant.joint_torque(world, reference, q, v, jnp.zeros((2, 6)), DT)
        new = v + DT * accelerate(body, drag, force.at[6:].add(torque.reshape(-1)))
        return advance(q, new), new, _noted(seen(body, contact, torque), t)

    def _noted(saw: Any, t: Any) -> Any:
        return statistics.update(statistics.init(saw), saw, t, DT)

    body = jax.jit(jax.vmap(move))(many_qpos, many_qvel, times)
    contact = jax.jit(jax.vmap(touch))(body)
    force, drag = jax.jit(jax.vmap(forces))(body, contact)
    return {
        "MJX: kinematics, inertia, bias": (move, (many_qpos, many_qvel, times)),
        "contact at the corners": (touch, (body,)),
        "contact forces and damping matrix": (forces, (body, contact)),
        "solving for the acceleration": (accelerate, (body, drag, force)),
        "plan, inverse kinematics, feed-forward": (refer, (times,)),
        "integration": (advance, (many_qpos, many_qvel)),
        "tick": (tick, (many_qpos, many_qvel, times)),
    }


def microseconds(function: Any, arguments: tuple, options: dict[str, Any]) -> tuple[float, float]:
    """Time of a batch [us], and floating-point operations in it."""
    compiled = jax.jit(jax.vmap(function), compiler_options=options).lower(*arguments).compile()
    seconds = common.median_seconds(lambda: jax.block_until_ready(compiled(*arguments)), REPEATS, 0.05)
    return 1e6 * seconds, float((compiled.cost_analysis() or {}).get("flops", 0.0))


def main() -> None:
    """Time every piece and print one line each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robot", choices=robot.presets(), default="elkahlout")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args()
    result: dict[str, float] = {}
    flops = 0.0
    every = pieces(options.robot, options.batch)
    for name, (function, arguments) in every.items():
        result[name], flops = microseconds(function, arguments, runtime.options())
        print(f"{name:42s} {result[name]:8.0f} us for {options.batch} lanes", flush=True)
    plain, _ = microseconds(*every["tick"], {})
    print(f"{'tick without the options of runtime':42s} {plain:8.0f} us", flush=True)
    square = jax.random.normal(jax.random.key(2), (1024, 1024))
    product = eqx.filter_jit(lambda a: a @ a)
    limit = 2 * 1024**3 / common.median_seconds(lambda: jax.block_until_ready(product(square)), REPEATS, 0.05)
    share = flops / (1e-6 * result["tick"]) / limit
    print(
        f"the tick takes {flops / options.batch:.0f} operations a lane, {100 * share:.1f} % of the core's limit"
    )
    if options.json:
        print(
            json.dumps(
                {
                    "microseconds": result,
                    "plain_tick": plain,
                    "flops_per_lane": flops / options.batch,
                    "share": share,
                }
            )
        )


if __name__ == "__main__":
    main()
