"""Report of benchmarks: rows with time, error and memory from one run, and the machine of the measurement."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

Group = Literal["press", "squeeze", "materials", "scenes", "oracles", "real", "robot"]
GROUPS: tuple[Group, ...] = get_args(Group)  # real needs frames that are not shipped; robot must be named

NotNegative = Annotated[FiniteFloat, Field(ge=0)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Row(_Frozen):
    """One thing measured by one method at one resolution."""

    group: Group
    case: str
    variant: str = ""  # of the case: a depth, a material
    method: str  # tacsim, or a method for comparison: seed, textbook, tacchi-settings, layer
    resolution: str
    seconds: NotNegative  # median of the timed repetitions, without compiling
    spread: NotNegative | None  # interquartile range of the same [s]; None with fewer than three repetitions
    cpu_seconds: NotNegative  # median processor time of all threads; it does not depend on other load
    repeats: Annotated[int, Field(ge=1)]
    error: NotNegative
    error_unit: str
    against: str  # reference of the error
    peak_mb: Annotated[FiniteFloat, Field(gt=0)]  # of the process that measured this case alone [MB]
    substeps: Annotated[int, Field(ge=0)] | None = None
    figures: dict[str, FiniteFloat] = {}  # other numbers of the same run, with the unit at the end of each name
    note: str = ""


class Failure(_Frozen):
    """A case without a row."""

    group: Group
    case: str
    method: str
    resolution: str
    cause: str


class Missing(Failure):
    """A case that could not be measured with the available data, and the searched folder; not a failure."""


class Device(_Frozen):
    """The GPU on which kernels ran. None: not known."""

    backend: str  # of Taichi: cuda, vulkan, metal
    name: str | None = None
    memory_gb: NotNegative | None = None
    driver: str | None = None

    @property
    def title(self) -> str:
        return self.name or f"a {self.backend} device"


class Machine(_Frozen):
    """The machine of the measurement. The load averages show the load by other programs."""

    cpu: str
    cores: Annotated[int, Field(ge=1)]
    memory_gb: NotNegative | None
    system: str
    load_before: list[float] | None  # load averages of 1, 5 and 15 minutes; None where the system has none
    load_after: list[float] | None
    realtime: bool | None = None  # workers and mock controllers were real-time processes; None: not recorded
    device: Device | None = None  # None: kernels ran on the CPU


class Metadata(_Frozen):
    date: datetime
    commit: str | None  # of the checkout at the start of the run; None without one
    modified: bool | None  # the checkout had changes that were not committed
    changed: bool  # the code changed during the run: its rows are not all of one version
    versions: dict[str, str]  # Python and packages
    machine: Machine
    groups: list[Group]
    baselines: bool
    long: bool = False  # our long rows were measured too
    repeat: Annotated[int, Field(ge=1)]
    seconds: NotNegative  # the whole run
    group_seconds: dict[Group, NotNegative] = {}  # of our short cases of each group: its time without options


class Report(_Frozen):
    """The content of the file of `tacsim bench --json FILE`."""

    schema_version: Literal[1] = 1
    metadata: Metadata
    results: list[Row]
    failures: list[Failure] = []
    missing: list[Missing] = []


def json_schema() -> dict[str, Any]:
    """JSON schema of the file that `tacsim bench --json` writes."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Report.model_json_schema()}
