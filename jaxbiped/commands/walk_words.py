"""Words that `jaxbiped walk` prints, from the numbers of its JSON object."""

from typing import Any

from jaxbiped.commands.common import outcome_in_words

REFLEX_WORDS = (
    ("reflex_end_s", "both feet down"),
    ("settled_s", "settled"),
    ("shifted_s", "x_ref shifted"),
    ("recovered_s", "step size recovered"),
    ("resumed_s", "walks on"),
)


def heading(robot: str, gait: str, steps: int) -> str:
    """Title of a walk."""
    return f"{robot}, {gait} gait, {steps} {'step' if steps == 1 else 'steps'}"


def lines(result: dict[str, Any]) -> list[str]:
    """Lines that tell a person what happened."""
    return [_what(result), *_plan(result), *_touches(result), *_reflexes(result), *_verdict(result)]


def _what(r: dict[str, Any]) -> str:
    parts = [f"{heading(r['robot'], r['gait'], r['steps'])}, {r['planned_s']:.1f} s"]
    if r["obstacles"]:
        pads = ", ".join(f"{100 * o['height_m']:+g} cm under step {o['step']}" for o in r["obstacles"])
        parts.append(f"obstacles {pads}")
    if r["payload"]:
        parts.append(_load(r, r["payload"]))
    parts.append(f"landing adaptation {r['variant']['landing']}, payload reflex {r['variant']['reflex']}")
    return "; ".join(parts)


def _load(r: dict[str, Any], load: dict[str, Any]) -> str:
    when = f"at {_time(r, load['time_s'])}" if load["time_s"] > 0.0 else "carried from the start"
    off = "" if load.get("end_s") is None else f", taken off at {_time(r, load['end_s'])}"
    return f"{load['mass_kg']:g} kg {when}{off}"


def _weight_changes(r: dict[str, Any]) -> bool:
    """Tell whether a load is put on, or taken off: not one that is carried all the time."""
    load = r["payload"]
    return bool(load) and (load["time_s"] > 0.0 or load.get("end_s") is not None)


def _plan(r: dict[str, Any]) -> list[str]:
    return [f"the plan breaks a constraint: {words}" for words in r["constraints_broken"]]


def _time(r: dict[str, Any], time: float) -> str:
    start = r["thesis_time_starts_s"]
    return f"{time:.3f} s" if start is None else f"{time:.3f} s (thesis {time - start:.3f} s)"


def _touches(r: dict[str, Any]) -> list[str]:
    if not r["touches"]:
        return ["no touches seen"]
    head = "  step  foot   kind      touch [s]  late [ms]  landing  added forward, up [mm]"
    return [head, *(_touch(touch) for touch in r["touches"])]


def _touch(t: dict[str, Any]) -> str:
    late = "" if t["late_s"] is None else f"{1e3 * t['late_s']:+.0f}"
    added = "" if t["delta_x_m"] is None else f"{1e3 * t['delta_x_m']:+.1f}, {1e3 * t['delta_z_m']:+.1f}"
    landing = t["landing"] or ""
    touch = f"  {t['step']:>4}  {t['foot']:<5}  {t['kind']:<8}  {t['time_s']:>9.3f}"
    return f"{touch}  {late:>9}  {landing:<7}  {added}".rstrip()


def _reflexes(r: dict[str, Any]) -> list[str]:
    if not r["reflexes"]:
        felt_nothing = _weight_changes(r) and r["variant"]["reflex"] != "off"
        return ["no reflex: the load was not felt"] if felt_nothing else []
    return [_reflex(r, i, reflex) for i, reflex in enumerate(r["reflexes"])]


def _reflex(r: dict[str, Any], i: int, reflex: dict[str, Any]) -> str:
    times = ", ".join(f"{word} {reflex[key]:.3f}" for key, word in REFLEX_WORDS if reflex[key] is not None)
    shift = "" if reflex["x_shift_m"] is None else f"; x_ref moved by {1e3 * reflex['x_shift_m']:+.1f} mm"
    head = f"reflex {i + 1} at {_time(r, reflex['triggered_s'])}"
    return f"{head}: {times}{shift}" if times else head


def _verdict(r: dict[str, Any]) -> list[str]:
    margins = [f"tilt margin {r['tilt_margin_deg']:.1f} deg"]
    if r["steps_without_touch"]:
        margins.append(f"{r['steps_without_touch']} steps without a touch")
    if r["out_of_reach_s"]:
        margins.append(f"targets out of reach for {r['out_of_reach_s']:.2f} s")
    ended = outcome_in_words({**r, "status": "simulation ended"})
    return [f"{_judged(r)}; {', '.join(margins)}", ended]


def _judged(r: dict[str, Any]) -> str:
    until = r["had_to_stand_until_s"]
    if r["success"]:
        rule = "two whole steps after load and recovery" if _weight_changes(r) else "the walk is finished"
        later = f"; {r['status']} at {r['end_time_s']:.2f} s, after that" if r["status"] != "ok" else ""
        return f"success: {rule}, at {until:.2f} s{later}"
    if r["status"] == "unfinished":
        if r["reflexes"] and r["reflexes"][-1]["resumed_s"] is None:
            return f"unfinished: still in reflex {len(r['reflexes'])} when the simulation ended"
        if not _weight_changes(r):
            return "unfinished: the simulation ended before the walk"
        return "unfinished: the walk had no two whole steps left after load and recovery"
    so_far = "before it walked on" if until is None else f"had to stand until {until:.2f} s"
    return f"failure: {r['status']} at {r['end_time_s']:.2f} s, {so_far}"
