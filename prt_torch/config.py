"""A run's configuration: composed by Hydra, validated by pydantic.

Hydra puts ``configs/`` and the overrides of the command line together; the models of
:mod:`prt_torch.settings` say what every key means, its type and its range. Whatever is wrong
becomes one line that names the key and the choices.
"""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import ValidationError
from yaml import MarkedYAMLError, YAMLError

from prt_torch.errors import InputError
from prt_torch.settings import KINDS, RunConfig

USAGE = """\
usage: python {script} [--config-name NAME] [-m] [KEY=VALUE ...]

  KEY=VALUE            override a key: scene.mesh=bunny.obj representation.rank=8
  -m                   run a grid: representation.rank=4,8,16
  --config-name NAME   start from configs/NAME.yaml (default fit)

keys of configs/{name}.yaml and its groups:
"""


def parse_command_line(
    arguments: list[str], config_dir: Path, *, default_name: str, script: str
) -> Iterator[RunConfig]:
    """Runs that a command line asks for: one, or the points of a grid with ``-m``.

    All of them are validated before the first is returned.

    Raises:
        InputError: If a key, type, value or choice is wrong.
        SystemExit: With status 0, after ``--help``.
    """
    name, overrides, grid = default_name, [], False
    rest = iter(arguments)
    for argument in rest:
        match argument:
            case "-m" | "--multirun":
                grid = True
            case "-h" | "--help":
                plain = _compose(config_dir, name, [])
                print(USAGE.format(script=script, name=name) + OmegaConf.to_yaml(plain), end="")
                raise SystemExit(0)
            case "--config-name":
                name = next(rest, "")
            case _ if argument.startswith("--config-name="):
                name = argument.partition("=")[2]
            case _ if argument.startswith("-"):
                raise InputError(f"{argument}: unknown option; see --help")
            case _:
                overrides.append(argument)
    points = _grid_points(overrides) if grid else [overrides]
    configs = [load_config(config_dir, name, point) for point in points]
    folders = [config.out for config in configs if config.out is not None]
    if len(set(folders)) < len(folders):
        raise InputError(f"out: one folder cannot hold several runs of a grid, got {folders[0]!r}")
    return iter(configs)


def load_config(config_dir: Path, name: str, overrides: list[str]) -> RunConfig:
    """Compose and validate one run.

    Raises:
        InputError: If a key, type, value or choice is wrong.
    """
    composed = _compose(config_dir, name, overrides)
    try:
        content = OmegaConf.to_container(composed, resolve=True)
    except OmegaConfBaseException as error:
        raise InputError(f"configuration: {first_line(error)}") from error
    if isinstance(content, dict):
        named = content.get("representations")
        if isinstance(named, list):
            content["representations"] = [_by_name(config_dir, entry) for entry in named]
    try:
        return RunConfig.model_validate(content)
    except ValidationError as error:
        raise InputError(_describe(error)) from error


def _compose(config_dir: Path, name: str, overrides: list[str]) -> Any:
    if not (config_dir / f"{name}.yaml").is_file():
        choices = ", ".join(sorted(path.stem for path in config_dir.glob("*.yaml")))
        raise InputError(f"--config-name={name}: no such configuration; expected one of {choices}")
    forced = [_forced(_parse(override, grid=False)) for override in overrides]
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_dir.resolve()), version_base="1.3"):
            return compose(name, overrides=forced)
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError) as error:
        raise InputError(f"configuration: {_explain(error)}") from error


_GROUPS = ("scene", "material", "light", "transfer", "representation", "fit", "preview")


def _parse(override: str, *, grid: bool) -> Override:
    """One override, with a key that is or lies in one of a run.

    Raises:
        InputError: If it is none, or lists several values outside a grid.
    """
    try:
        parsed = OverridesParser.create().parse_override(override)
    except HydraException as error:
        raise InputError(
            f"{override}: not KEY=VALUE; a value with special characters needs quotes of its own, "
            "as in scene.mesh='\"a=b.obj\"'"
        ) from error
    key = parsed.get_key_element().lstrip("+~")
    if key.partition(".")[0] not in RunConfig.model_fields:
        choices = ", ".join(RunConfig.model_fields)
        raise InputError(f"{key or override}: unknown key; expected one of {choices}")
    if parsed.is_sweep_override():
        if not grid:
            raise InputError(f"{override}: several values; use -m for a grid, [a,b] for a list")
    elif key in _GROUPS and not parsed.is_delete() and not isinstance(parsed.value(), str):
        raise InputError(f"{key}: expected the name of a file in configs/{key}, got {override}")
    return parsed


def _forced(override: Override) -> str:
    """``a.b=1`` as ``++a.b=1``: set whether or not the key is there; groups are left alone.

    Unknown keys go through like this, for the validation to name them beside the known ones.
    """
    line = override.input_line or ""
    if override.is_delete() or override.key_or_group in _GROUPS:
        return line
    return "++" + line.lstrip("+")


def _grid_points(overrides: list[str]) -> list[list[str]]:
    """The product of all overrides that list several values."""
    choices = []
    for override in overrides:
        parsed = _parse(override, grid=True)
        if not parsed.is_sweep_override():
            choices.append([override])
            continue
        try:
            values = list(parsed.sweep_string_iterator())
        except HydraException as error:
            raise InputError(f"{override}: {first_line(error)}") from error
        choices.append([f"{parsed.get_key_element()}={value}" for value in values])
    return [list(point) for point in itertools.product(*choices)]


def _by_name(config_dir: Path, entry: Any) -> Any:
    """A representation given by its name alone takes the defaults of its group file."""
    if not isinstance(entry, str):
        return entry
    file = config_dir / "representation" / f"{entry}.yaml"
    if not file.is_file():
        choices = ", ".join(sorted(path.stem for path in file.parent.glob("*.yaml")))
        raise InputError(f"representations: unknown {entry!r}; expected one of {choices}")
    try:
        return OmegaConf.to_container(OmegaConf.load(file), resolve=True)
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        raise InputError(f"representations: {entry}: {first_line(error)}") from error


def _explain(error: Exception) -> str:
    """Hydra's message in one line, with the choices of a group if it lists them."""
    text = str(error)
    missing = re.search(r"Could not find '([^/]+)/(.*)'", text)
    if missing:
        options = re.findall(r"^\t(\w+)$", text.partition("Available options")[2], re.MULTILINE)
        choices = ", ".join(options)
        return f"{missing[1]}: unknown {missing[2]!r}; expected one of {choices}"
    return first_line(error).replace("++", "")


def first_line(error: Exception) -> str:
    """What is wrong, in one line; in YAML with its place."""
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        file = "" if mark.name.startswith("<") else f"{mark.name}, "  # else given as a string
        return f"{file}line {mark.line + 1}, column {mark.column + 1}: {error.problem}"
    return next((line.strip() for line in str(error).splitlines() if line.strip()), repr(error))


def _describe(error: ValidationError) -> str:
    """The first problem in one line: key, what was expected, what was given."""
    problem = error.errors()[0]
    # The kind of a representation stands in the place of an error, but not in its key.
    key = ".".join(str(part) for part in problem["loc"] if part not in KINDS)
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    match problem["type"]:
        case "extra_forbidden":
            *section, _ = problem["loc"]
            return f"{key}: unknown key; expected one of {', '.join(_keys_of(section))}{more}"
        case "union_tag_invalid" | "union_tag_not_found":
            given = problem["input"].get("name") if isinstance(problem["input"], dict) else None
            return f"{key}.name: expected one of {', '.join(KINDS)}, got {given!r}{more}"
    message = problem["msg"][:1].lower() + problem["msg"][1:]
    if isinstance(problem["input"], dict):  # a whole section would say nothing
        return f"{key}: {message}{more}"
    given = repr(problem["input"])
    return f"{key}: {message}, got {given if len(given) < 80 else given[:77] + '...'}{more}"


def _keys_of(section: list[Any]) -> list[str]:
    """The keys that a section of the configuration has."""
    model: Any = RunConfig
    for part in section:
        fields = getattr(model, "model_fields", {})
        if part in KINDS:
            model = KINDS[part]
        elif part in fields:
            model = fields[part].annotation
        elif not fields:  # a list of sections, or sections by name
            model = get_args(model)[-1]
    return list(model.model_fields)
