"""What a sweep's configuration may say: what to sweep, where, and a budget if one is to be met.

A sweep has the keys of a run (:mod:`prt_torch.settings`), which say what is baked and lit, from
``configs/sweep.yaml``; and two sections of its own, ``sweep`` and ``budget``. ``sweep`` comes from
a file in ``configs/sweep``, chosen by ``sweep=NAME``; single keys are overridden as usual.
"""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from yaml import YAMLError

from prt_torch.config import first_line, load_config
from prt_torch.errors import InputError
from prt_torch.settings import KINDS, RunConfig

_LISTS = {"ranks"}  # parameters whose single value is a list
_NOT_SWEPT = {"name", "max_error", "max_bytes", "max_relight_seconds", "reclassify"}

USAGE = """\
usage: python {script} [--config-name NAME] [KEY=VALUE ...]

  KEY=VALUE            override a key: scene.mesh=bunny.obj sweep=small sweep.workers=2
  budget.bytes=N       pick one representation and its parameters within a budget; also
                       budget.error=E and budget.relight_ms=T, alone or together
  --config-name NAME   start from configs/NAME.yaml (default sweep)

keys of configs/{name}.yaml and its groups, and of the sweep:
"""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SlurmConfig(_Section):
    """A job of a cluster's queue for each chain, by submitit."""

    partition: str | None = None
    minutes: int = Field(60, ge=1, description="limit of a chain")
    cpus: int = Field(2, ge=1, description="of a chain")


class SweepConfig(_Section):
    """What is swept and by whom."""

    representations: list[dict[str, Any]] = Field(
        ..., min_length=1, description="name, and a value or a list of values for each parameter"
    )
    nested: bool = Field(True, description="read small ones off larger fits; false fits every one")
    waterfall: bool = Field(True, description="take the error of one result apart; bakes anew")
    workers: int | None = Field(None, ge=1, description="processes; null is one for each core")
    executor: Literal["processes", "here", "dask", "slurm"] = Field(
        "processes", description="what runs the chains"
    )
    dask_address: str | None = Field(None, description="scheduler; null is a cluster made here")
    slurm: SlurmConfig = SlurmConfig.model_validate({})

    def grids(self) -> list[tuple[str, dict[str, list[Any]]]]:
        """The kind and the values of each parameter of every entry.

        Raises:
            InputError: If a kind or a parameter is unknown, or a value out of range.
        """
        return [_grid(at, entry) for at, entry in enumerate(self.representations)]


class BudgetConfig(_Section):
    """Limits that one representation is to keep; none of them sweeps without picking."""

    bytes: int | None = Field(None, ge=1, description="of storage")
    error: float | None = Field(None, gt=0, description="squared, over the squared norm")
    relight_ms: float | None = Field(None, gt=0, description="of one light, milliseconds")

    @property
    def given(self) -> bool:
        """Whether there is any limit."""
        return (self.bytes, self.error, self.relight_ms) != (None, None, None)


class SweepRun(_Section):
    """A whole sweep."""

    run: RunConfig
    sweep: SweepConfig
    budget: BudgetConfig = BudgetConfig.model_validate({})


def parse_sweep(arguments: list[str], config_dir: Path, *, script: str) -> SweepRun:
    """The sweep that a command line asks for, composed and validated.

    Raises:
        InputError: If a key, type, value or choice is wrong.
        SystemExit: With status 0, after ``--help``.
    """
    name, group, run, own = "sweep", "default", [], []
    rest = iter(arguments)
    for argument in rest:
        key = argument.partition("=")[0]
        match argument:
            case "-h" | "--help":
                _print_help(config_dir, name, group, script)
                raise SystemExit(0)
            case "--config-name":
                name = next(rest, "")
            case _ if argument.startswith("--config-name="):
                name = argument.partition("=")[2]
            case _ if argument.startswith("-"):
                raise InputError(f"{argument}: unknown option; see --help")
            case _ if key == "sweep":
                group = argument.partition("=")[2]
            case _ if key.partition(".")[0] in ("sweep", "budget"):
                own.append(argument)
            case _:
                run.append(argument)
    sections = _sections(config_dir, group, own)
    base = load_config(config_dir, name, run)
    if base.fit.max_steps:
        raise InputError(
            f"fit.max_steps: a sweep is of closed forms; expected 0, got {base.fit.max_steps}"
        )
    try:
        found = SweepRun.model_validate({"run": base, **sections})
    except ValidationError as error:
        raise InputError(_first_problem(error)) from error
    found.sweep.grids()
    if found.sweep.waterfall and base.transfer.max_bounces and base.material.is_glossy:
        raise InputError(
            "sweep.waterfall: its truth is light by texels, in which glossy materials bounce no "
            "light; set it to false, or transfer.max_bounces=0"
        )
    return found


def _print_help(config_dir: Path, name: str, group: str, script: str) -> None:
    plain = load_config(config_dir, name, []).model_dump(mode="json")
    sections = {
        **plain,
        **_sections(config_dir, group, []),
        "budget": BudgetConfig.model_validate({}).model_dump(),
    }
    print(USAGE.format(script=script, name=name) + OmegaConf.to_yaml(sections), end="")


def _sections(config_dir: Path, group: str, overrides: list[str]) -> dict[str, Any]:
    """The sweep's own sections from their file and what overrides it."""
    file = config_dir / "sweep" / f"{group}.yaml"
    if not file.is_file():
        choices = ", ".join(sorted(path.stem for path in file.parent.glob("*.yaml")))
        raise InputError(f"sweep: unknown {group!r}; expected one of {choices}")
    given = [_override(one) for one in overrides]
    try:
        whole = OmegaConf.merge({"sweep": OmegaConf.load(file)}, *given)
        return dict(OmegaConf.to_container(whole, resolve=True))  # type: ignore[arg-type]
    except (OmegaConfBaseException, YAMLError, ValueError, AttributeError) as error:
        raise InputError(f"sweep: {first_line(error)}") from error


def _override(text: str) -> DictConfig:
    if "=" not in text:
        raise InputError(f"{text}: not KEY=VALUE")
    try:
        return OmegaConf.from_dotlist([text])
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        raise InputError(f"{text}: {first_line(error)}") from error


def _grid(at: int, entry: Mapping[str, Any]) -> tuple[str, dict[str, list[Any]]]:
    """One entry's kind and values, each combination of them validated."""
    where, kind = f"sweep.representations.{at}", entry.get("name")
    if kind not in KINDS:
        raise InputError(f"{where}.name: expected one of {', '.join(KINDS)}, got {kind!r}")
    fields = [name for name in KINDS[kind].model_fields if name not in _NOT_SWEPT]
    grid = {}
    for name, given in entry.items():
        if name == "name":
            continue
        if name not in fields:
            raise InputError(f"{where}.{name}: unknown key; expected one of {', '.join(fields)}")
        single = not isinstance(given, list) or (
            name in _LISTS and not any(isinstance(part, list) for part in given)
        )
        grid[name] = [given] if single else given
        if not grid[name]:
            raise InputError(f"{where}.{name}: expected at least one value, got []")
        if any(grid[name].count(value) > 1 for value in grid[name]):
            raise InputError(f"{where}.{name}: expected different values, got {given}")
    for choice in itertools.product(*grid.values()):
        try:
            KINDS[kind].model_validate({"name": kind, **dict(zip(grid, choice, strict=True))})
        except ValidationError as error:
            raise InputError(f"{where}.{_first_problem(error)}") from error
    return kind, grid


def _first_problem(error: ValidationError) -> str:
    """Key, what was expected and what was given, in one line."""
    problem = error.errors()[0]
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"{key}: unknown key; see --help"
    message = problem["msg"][:1].lower() + problem["msg"][1:]
    if isinstance(problem["input"], dict):
        return f"{key}: {message}"
    return f"{key}: {message}, got {str(problem['input'])[:80]!r}"
