"""The lines of a run's record, for their JSON schema: what `bench.run` writes, as models."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import ConfigDict, Field

from bench.base.result_model import ResultModel
from bench.readings.columns import Rail
from bench.readings.table import Outlier

Three = Field(min_length=3, max_length=3)


class ReadingPart(ResultModel):
    """The measured values of a reading step."""

    installation: str
    series: int
    pass_: int = Field(alias="pass")
    point: int
    target_deg: float | None
    angle_deg: float | None
    direction: Literal[-1, 0, 1]
    time_s: float
    temperature_c: float | None
    temperature_source: str = Field("", description="thermometer at the block; empty if there is none")
    chamber_c: float | None = None
    """temperature of the air in the chamber, °C, if `temperature_c` is that of the block"""
    meter_temperature_c: float | None = None
    """temperature of the voltmeters, °C, if measured"""
    room_c: float | None = Field(None, description="temperature of the room, °C, if measured")
    unit: str
    mean: list[float] = Three
    sd: list[float | None] = Three
    samples_taken: int
    samples: dict[str, list[float]] = Field(description="samples by channel")
    drift: list[float | None] = Three
    drift_p: list[float | None] = Three
    outlier: list[Outlier | None]
    reference_v: float | None
    scan_order: str | None
    rails: dict[str, Rail] = Field({}, description="supply rails by name, if the bench file states them")


class NowPart(ResultModel):
    """The goal that is still furthest away."""

    model_config = ConfigDict(extra="allow")

    goal: str = ""
    u: float = 0.0
    asked: float | None = None
    unit: str = ""


class EventLine(ResultModel):
    """One event of a run's record, a line of events.jsonl; `prev` links the events to a chain of hashes.

    An event step_done has further members that depend on the kind of step, such as `angle_deg` for a turn.
    """

    model_config = ConfigDict(extra="allow")

    n: int = Field(description="number of the event, from 1")
    time: str = Field(description="civil time of the event")
    bench_s: float = Field(description="time since the start of the run, s; virtual in a dry run")
    type: str = Field(description="type of event: run_started, step_started, step_done, asked, answered, …")
    prev: str = Field(description="SHA-256 of the previous line; for the first line, of run.json")
    step: int = Field(0, description="number of the step in the plan, from 0")
    key: str = Field("", description="key of the step, which determines the random numbers of a dry run")
    attempt: int = 1
    reading: ReadingPart | None = None
    instruments: dict[str, str] = Field({}, description="identities of the instruments; in run_started")
    serials: dict[str, str] = Field({})
    """serial numbers that the instruments stated; in run_started of a real run, and of a dry run if the bench
    file has certificates
    """
    id: str = Field("", description="number of the question; in asked and answered")
    kind: Literal["confirm", "choose", "number", "angle"] = "confirm"
    """kind of answer that the question requires; in asked"""
    text: str = Field("", description="text of the question; in asked")
    default: str | None = Field(None, description="meaning of an empty answer; in asked")
    unit: str = Field("", description="unit of the answer; in asked")
    choices: list[str] = Field([])
    """possible answers; one that ends in REASON asks for the person's own words; in asked"""
    minimum: float | None = Field(None, description="smallest possible answer; in asked")
    maximum: float | None = Field(None, description="largest possible answer; in asked")
    action: dict[str, Any] = Field({}, description="required action (`do`) with its details; in asked")
    picture: str = Field("", description="drawing in characters; in asked")
    answer: str = Field("", description="answer as used (in answered), or as given (in answer_refused)")
    line: int = Field(1, description="line of answers.jsonl that held the answer, from 1")
    why: str = Field("", description="reason of a refusal; in answer_refused and wish_refused")
    by: str = Field("", description="person who gave the answer or command, if known")
    role: str = Field("", description="role of this person: operator, supervisor or viewer")
    where: str = Field("", description="where it was given: terminal, panel or command (`bench control`)")
    visit: int = Field(0, description="number of the mounting, from 0; in chosen")
    settings: int = Field(0, description="number of points measured so far; in chosen")
    repeats: int = Field(0, description="number of these points that repeat another; in chosen")
    now: NowPart | None = None
    """goal that is furthest from being reached; null before the coefficients are determined; in chosen"""
    stop: str = Field("", description="reached, used up or time; empty if measuring continues; in chosen")
    left_out: list[list[int]] = Field([], description="ranges of steps that are not needed; in chosen")
    taken_up: list[list[int]] = Field([], description="steps left out before but needed; in chosen")
    next: dict[str, Any] = Field({}, description="next points, with their duration and benefit; in chosen")
    in_all: dict[str, Any] = Field({}, description="expected totals at the end of the run; in chosen")
    undecided: dict[str, Any] = Field({}, description="steps that depend on later choices; in chosen")
    not_needed: int = 0
    """points of the procedure that were not measured; in the last chosen"""
