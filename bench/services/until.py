"""Runs that continue until goals for the uncertainty are reached; the findings of `bench check`."""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from bench.base.languages import message
from bench.base.units import ACCELERATION, DURATION, SCALE_FACTOR, VOLTAGE
from bench.base.yaml_files import FileMistakes
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.devices.device import is_serial
from bench.config.procedure.check import (
    check,
    disk_needed_bytes,
    largest_signal_v,
    operator_actions,
    orientations,
    prompts_without_default,
    undetermined,
)
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Plan
from bench.config.shipped import find_procedure
from bench.model.conditions import Mounting
from bench.model.effects import CATALOGUE
from bench.model.forward import ForwardModel
from bench.planning import optimal_design as design
from bench.planning.choice import Chooser, Standing, TimeOutlook, scale_of, telling_apart, time_outlook
from bench.planning.pool import (
    NO_GOAL,
    Aim,
    Floor,
    Pool,
    Site,
    UntilGoal,
    floors,
    pool_of,
    reached_by,
    with_hidden,
)
from bench.planning.requirements import Cost, Outlook, mountings_of, outlook, settings_of
from bench.readings.table import VERIFICATION
from bench.results.check import (
    CheckResult,
    DiskPart,
    Findings,
    OpenCoefficients,
    disk_space,
    observability_part,
    outlook_in_words,
    until_part,
)
from bench.run.events import Manifest
from bench.run.folder import BENCH, Run
from bench.run.resume import PlanProgress
from bench.run.sentences import size_in_words
from bench.services.bench_selection import bench_path
from bench.services.calibration import calibration_of
from bench.services.errors import Refused, named, quantity
from bench.services.planning import delta_g_of, stand_of
from bench.services.requests.measuring import Check
from bench.services.requests.shared import runs_folder
from bench.services.source import Request, load_sources
from bench.services.traceability import NOTHING_LEARNED, LearnedTaken, learned_for_run, remarks, with_effects
from bench.services.validated import reminders, without_gravity
from drivers.clock import utc_now

COMBINED: Final = "combined:"
EXAMPLE: Final = "all=5e-5 (V/g and V), combined:Kxx=1e-4, delta-g=1e-4, vector=7e-5, modulus=1e-3 or time=4h"
_PARTS_TOLD: Final = 3


# --- what is asked for ------------------------------------------------------------------------------


def stated_aim(texts: Sequence[str], stand: design.Stand, bench: BenchFile) -> Aim:
    """Return the goals in the `texts` of `--until`, separated by commas. Raises `Refused` with all mistakes."""
    wanted: list[UntilGoal] = []
    limit_s: float | None = None
    sizes: dict[bool, dict[str, float]] = {False: {}, True: {}}
    mistakes = []
    for text in (part.strip() for given in texts for part in given.split(",") if part.strip()):
        try:
            name, size = named("--until", text, EXAMPLE)
            combined = name.startswith(COMBINED)
            name = name.removeprefix(COMBINED).strip()
            if name == "time" and not combined:
                limit_s = quantity("--until", size, DURATION, plain=False)
                if not limit_s > 0:
                    raise Refused(f"--until {text}: give a positive time")
            elif name in ("delta-g", "vector", "modulus"):
                wanted += _of_force(name, quantity("--until", size, ACCELERATION), stand, bench, combined)
            else:
                unit = VOLTAGE if name.startswith("U0") else SCALE_FACTOR
                design.coefficient_goals({name: (asked := quantity("--until", size, unit))})
                sizes[combined][name] = asked
        except Refused as mistake:
            said = mistake.typed
            mistakes.append(said if text in said else f"--until {text}: {said.removeprefix('--until ')}")
        except CalibrationError as mistake:
            mistakes.append(f"--until {text}: {mistake}")
    if mistakes:
        raise Refused("\n".join(mistakes))
    for combined, asked_of in sizes.items():
        wanted += [UntilGoal(goal, combined) for goal in design.coefficient_goals(asked_of)]
    if not wanted and limit_s is None:
        raise Refused(f"--until: no goal is stated; state one, such as {EXAMPLE}")
    if not wanted:
        return Aim((UntilGoal(design.vector_goal(stand.block, 1.0, NO_GOAL)),), limit_s)
    whole = UntilGoal(design.whole_goal(stand.block, [one.goal for one in wanted]))
    return Aim((*wanted, whole), limit_s)


def _of_force(
    name: str, asked: float, stand: design.Stand, bench: BenchFile, combined: bool
) -> list[UntilGoal]:
    if name == "delta-g" and combined:
        raise Refused(
            "--until combined:delta-g: gain and zero of the meters cancel in Δg; give delta-g, and read "
            "the combined u from 'bench verify'"
        )
    goals: list[design.Goal] = []
    match name:
        case "delta-g":
            goals = delta_g_of(stand, asked, "--until delta-g")
        case "vector":
            if not asked > 0:
                raise Refused(f"--until vector={asked:g}: give a positive uncertainty")
            goals = [design.vector_goal(stand.block, 1.0, asked)]
        case _:
            goals = design.modulus_goals(stand.block, bench.unit_under_test.range, asked)
    return [UntilGoal(goal, combined) for goal in goals]


def chooser_of(
    plan: Plan, bench: BenchFile, texts: Sequence[str], learned: LearnedTaken = NOTHING_LEARNED
) -> Chooser:
    """Return the chooser that picks the settings of a run for its goals, the `texts` of `--until`.

    Raises `Refused` for goals that are invalid or out of reach.
    """
    model = with_effects(ForwardModel(bench.installation_models()), learned.effects)
    try:
        whole = replace(stand_of(bench, model, learned.known), mountings=mountings_of(plan))
        # u from the readings alone does not include the angles whose size nobody stated
        told = set() if learned.known is None else {kind for kind, _ in learned.known.keys}
        silent = assumed_stand(bench).keys() - told
        stated = {name: u for name, u in whole.sizes.items() if name not in silent}
        stand = replace(whole, sizes=stated, hidden=())
        aim = stated_aim(texts, stand, bench)
        pool = pool_of(plan, bench.line_frequency)
        # if combined u is asked for, points that show such an angle are worth their time
        by = replace(whole, hidden=()) if all(w.combined or w.goal.loose for w in aim.wanted) else stand
        aim = with_hidden(aim, by, whole, pool)
        _refuse_below_floor(floors(aim, stand, whole, pool))
        _refuse_too_short(aim, pool)
        return Chooser(pool, aim, by)
    except CalibrationError as reason:
        raise Refused(f"--until {', '.join(texts)}: {reason}") from None


def _refuse_below_floor(found: Sequence[Floor]) -> None:
    """Raise `Refused` for goals below the floor of u for any number of readings; name its main causes."""
    if not found:
        return
    worst = max(found, key=lambda floor: floor.u / floor.wanted.goal.asked)
    unit = worst.wanted.goal.unit
    parts = ", ".join(
        message(f"{size_in_words(u, unit)} from {name.replace('_', ' ')}")
        for name, u in worst.parts[:_PARTS_TOLD]
    )
    others = list(dict.fromkeys(f.wanted.name for f in found if f.wanted.name != worst.wanted.name))
    least, asked = size_in_words(worst.u, unit), size_in_words(worst.wanted.goal.asked, unit)
    raise Refused(
        f"--until: readings at these points cannot lower the {worst.wanted.name} to {asked}, only to {least} "
        f"({parts}); the {', '.join(others)} cannot reach their goals either; relax the goals, or reduce "
        "these errors"
        if others
        else f"--until: readings at these points cannot lower the {worst.wanted.name} to {asked}, only to {least} "
        f"({parts}); relax the goal, or reduce these errors"
    )


def _refuse_too_short(aim: Aim, pool: Pool) -> None:
    needed_s = pool.always_s + sum(v.time_s for v in pool.visits[:1])
    if aim.limit_s is not None and aim.limit_s <= needed_s:
        enough_h = (math.floor(needed_s / 36.0) + 1) / 100  # rounded up, so that this time is accepted
        raise Refused(
            f"--until time: {aim.limit_s / 3600:.3g} h are too short; warm-up, verification points and one "
            f"mounting take longer: give at least {enough_h:g} h"
        )


# --- what is chosen ---------------------------------------------------------------------------------


class Until:
    """The chooser of a run's next settings; it uses the record alone, so that a resumed run chooses the same."""

    def __init__(self, run: Run, bench: BenchFile) -> None:
        self._run = run
        learned = learned_for_run(bench, run.folder / BENCH, run.created, simulated=run.simulated)
        self._chooser = chooser_of(run.plan, bench, run.manifest.get("until", []), learned)
        self._point_of = {point.reads[0]: point for point in self._chooser.pool.points}

    def __call__(self, index: int, progress: PlanProgress) -> dict[str, Any] | None:
        """Return the choice of settings before step `index`, as JSON data; None if there is nothing to choose."""
        pool = self._chooser.pool
        last = progress.chosen[-1] if progress.chosen else None
        refused = frozenset(v.mount for v in pool.visits if v.mount_step in progress.skipped)
        comes, needless = pool.visits[0].first, frozenset[int]()
        if last is not None:
            if last["stop"]:
                return None
            visit = pool.visits[int(last["visit"])]
            comes = int(last["next"]["last"]) + 1
            if visit.mount in refused:
                own = {step for point in visit.points for step in point.steps} | set(visit.steps)
                needless = frozenset(own - progress.left_out - progress.done)
        again = any(step >= index and not progress.settled(step) for step in progress.redone)
        if (index < comes and not needless) or again:  # a reading to be repeated counts in the choice
            return None
        visited = -1 if last is None else int(last["visit"])
        choice = self._chooser.choose(self._standing(visited, refused, progress))
        return replace(choice, left_out=choice.left_out | needless).to_json()

    def _standing(self, visit: int, refused: frozenset[Mounting], progress: PlanProgress) -> Standing:
        """Return the state of the run on which the choice depends, read from its record on disk."""
        history = Run(self._run.folder).trusted_history()
        taken = {step: r for step, r in history.readings.items() if step in self._point_of}
        done: Counter[Site] = Counter()
        for step, reading in taken.items():
            site = self._point_of[step].site
            done[site._replace(mount=Mounting(reading.series, reading.installation))] += 1
        now = {
            Mounting(series, label): Mounting(visit_now, label)
            for (series, label), visit_now in progress.remounts.items()
        }
        skipped = {p.site for p in self._chooser.pool.points if p.steps[0] in progress.skipped}
        standing = Standing(
            visit,
            frozenset(self._point_of[step].steps[0] for step in taken),
            done,
            max((reading.time_s or 0.0 for reading in taken.values()), default=0.0),
            refused=frozenset(s._replace(mount=now.get(s.mount, s.mount)) for s in skipped),
            refused_mounts=refused,
            now=now,
        )
        return self._with_noise(standing) if taken else standing

    def _with_noise(self, standing: Standing) -> Standing:
        (source,) = load_sources(Request([str(self._run.folder)], self._run.folder.parent))
        readings = source.readings.select(source.readings.installation != VERIFICATION)
        standing = replace(standing, scale=scale_of(self._chooser.stand, readings))
        try:
            result = calibration_of(replace(source, readings=readings))
        except CalibrationError:
            return standing
        apart = self._telling_apart(standing) if result.calibration.lack_of_fit.shown else frozenset[Site]()
        own = result.calibration
        reached = reached_by(self._chooser.aim, own.covariance_readings, own.covariance)
        return replace(standing, reached=reached, apart=apart)

    def _telling_apart(self, standing: Standing) -> frozenset[Site]:
        """Return those unread sites of this mounting that best separate possible causes of a lack of fit."""
        open_sites = {standing.site_of(p) for p in self._chooser.open_points(standing.visit, standing)}
        sites = sorted(open_sites - set(standing.done))
        if not sites:
            return frozenset()
        done = [site.setting() for site, count in standing.done.items() for _ in range(count)]
        best = telling_apart(
            self._chooser.stand, done, [site.setting() for site in sites], list(CATALOGUE.values())
        )
        return frozenset(sites[i] for i in best)


# --- before the run ---------------------------------------------------------------------------------


def noted_goals(manifest: Manifest, plan: Plan, bench: BenchFile, texts: Sequence[str]) -> tuple[str, ...]:
    """Note the goals in the manifest; return notes on what was learned, and on the duration. Raises `Refused`."""
    manifest["until"] = [*texts]
    learned = learned_for_run(
        bench, Path(manifest["bench"]), manifest["created"], simulated=bool(manifest["dry_run"])
    )
    return (*learned.notes, outlook_in_words(outlook_until(plan, bench, texts, learned)))


def outlook_until(
    plan: Plan, bench: BenchFile, texts: Sequence[str], learned: LearnedTaken = NOTHING_LEARNED
) -> TimeOutlook:
    """Return the expected duration of a run with goals `texts`, for the learned or else the stated noise."""
    found = time_outlook(chooser_of(plan, bench, texts, learned))
    return replace(found, learned=learned.known is not None and learned.known.noise is not None)


def look_ahead(request: Check) -> Findings:
    """Return the findings of `bench check`: plan and expected outcome. Raises `Refused` with all mistakes."""
    if request.procedure is None:
        raise Refused("no procedure is named; name one to check, or check the bench with --morning")
    plan, file = _load(request.procedure, request.bench)
    found = findings_of(plan, file, runs_folder(request.runs))
    if not request.until:
        return found
    learned = learned_for_run(file, bench_path(request.bench), utc_now().isoformat(), simulated=None)
    until = outlook_until(plan, file, request.until, learned)
    result = found.result.model_copy(update={"until": until_part(until)})
    return replace(found, result=result, until=until)


def _load(procedure: str, bench_name: str | Path | BenchFile | None) -> tuple[Plan, BenchFile]:
    plan: Plan | None = None
    bench: BenchFile | None = None
    mistakes = []
    try:
        plan = load_procedure(find_procedure(procedure)).expand()
    except FileMistakes as error:
        mistakes.append(str(error))
    try:
        bench = load_bench(bench_path(bench_name))
    except FileMistakes as error:
        mistakes.append(str(error))
    if plan is None or bench is None:
        raise Refused("\n".join(mistakes))
    return plan, bench


def findings_of(plan: Plan, bench: BenchFile, runs: Path) -> Findings:
    """Return the findings of `bench check` on a plan; `runs` is the folder whose free space is checked."""
    supply = bench.unit_under_test.supply
    needed, free = disk_needed_bytes(plan), _free_bytes(runs)
    problems = check(plan, bench)
    if needed > free:
        problems.append(
            f"{runs}: a run needs about {disk_space(needed)} of disk, and {disk_space(free)} are free; "
            "free disk space or choose another folder with --runs"
        )
    open_at = {at_c: undetermined(force) for at_c, force in orientations(plan, bench).items()}
    outlook = _outlook(plan, bench) if () in open_at.values() else None
    by_kind_s = plan.duration_by_kind_s(bench.line_frequency, supply)
    result = CheckResult(
        procedure=plan.name,
        bench=bench.name,
        plan_hash=plan.hash,
        steps=len(plan.steps),
        counts=plan.counts(),
        operator_actions=operator_actions(plan, bench),
        expected_s=sum(by_kind_s.values()),
        expected_by_kind_s=by_kind_s,
        expected_by_installation_s=plan.duration_by_mount_s(bench.line_frequency, supply),
        longest_s=plan.longest_duration_s(bench.line_frequency, supply),
        disk=DiskPart(folder=str(runs), needed_bytes=needed, free_bytes=free),
        largest_signal_v=largest_signal_v(plan, bench),
        not_determined=[
            OpenCoefficients(temperature_c=at_c, coefficients=list(names)) for at_c, names in open_at.items()
        ],
        observability=outlook and observability_part(outlook),
        problems=problems,
        dry_run_refuses=list(prompts_without_default(plan)),
        hints=list(_hints(bench)),
    )
    return Findings(result, plan, bench, outlook, None)


def _hints(bench: BenchFile) -> Iterator[str]:
    """Yield remarks on certificates, and hints on likely mistakes that only show on a real bench."""
    yield from remarks(bench)
    yield from reminders(bench)
    yield from without_gravity(bench)
    for meter in bench.instruments.voltmeters:
        if is_serial(meter.resource) and meter.interface == "lan":
            yield (
                f"{meter.name}: {meter.resource} is a serial port, where a real meter needs remote mode; state "
                "'interface: rs232' (without this line, the program takes it for a meter of 'bench simulate')"
            )


def _outlook(plan: Plan, bench: BenchFile) -> Outlook | None:
    """Return what the readings of a plan leave open, and remedies; None for an unknown installation."""
    settings = settings_of(plan)
    installations = bench.installation_models()
    if not {s.mount.installation for s in settings} <= set(installations):
        return None
    cost = Cost.of_plan(plan, bench.line_frequency)
    return outlook(settings, ForwardModel(installations), bench.nominal_block(), cost)


def _free_bytes(folder: Path) -> int:
    """Return the free bytes on the disk of `folder` or, if it is missing, of its nearest parent."""
    path = folder.resolve()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free
