"""Configurations: what ships is valid, and what is wrong is one line that says what is right."""

import inspect
import shutil
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from pydantic import BaseModel

from prt_torch.baking import bake
from prt_torch.config import load_config, parse_command_line
from prt_torch.errors import InputError
from prt_torch.representations import CPCA
from prt_torch.settings import RunConfig
from prt_torch.sweep import parse_sweep

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
COMPLETE = sorted(path.stem for path in CONFIGS.glob("*.yaml"))
GROUPS = ("scene", "material", "light", "transfer", "representation", "fit", "preview")
IN_GROUPS = sorted(
    (path.parent.name, path.stem)
    for path in CONFIGS.glob("*/*.yaml")
    if path.parent.name != "sweep"  # of train/sweep.py: tests/test_sweep.py
)
REPRESENTATIONS = sorted(stem for group, stem in IN_GROUPS if group == "representation")


def parse(*arguments: str) -> list[RunConfig]:
    return list(
        parse_command_line(list(arguments), CONFIGS, default_name="fit", script="train/fit.py")
    )


def one(*arguments: str) -> RunConfig:
    (config,) = parse(*arguments)
    return config


def refusal(*arguments: str) -> str:
    with pytest.raises(InputError) as caught:
        parse(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 400
    return message


class TestShippedConfigurations:
    def test_there_are_some(self):
        assert {"fit", "demo"} <= set(COMPLETE)
        assert {group for group, _ in IN_GROUPS} == set(GROUPS)

    @pytest.mark.parametrize("name", COMPLETE)
    def test_each_is_valid(self, name):
        config = load_config(CONFIGS, name, [])
        assert config.fitted
        assert config.light.test

    @pytest.mark.parametrize(("group", "name"), IN_GROUPS)
    def test_each_choice_of_a_group_is_valid_and_taken(self, group, name):
        section = getattr(load_config(CONFIGS, "fit", [f"{group}={name}"]), group)
        file = OmegaConf.to_container(OmegaConf.load(CONFIGS / group / f"{name}.yaml"))
        assert section.model_dump(mode="json") == file  # complete: no key is left to a default

    def test_fit_says_what_the_models_say(self):
        config = one()
        for name, field in RunConfig.model_fields.items():
            value = getattr(config, name)
            if isinstance(value, BaseModel):
                for key, inner in type(value).model_fields.items():
                    # The lights are what a light group is there to choose.
                    if not inner.is_required() and (name, key) != ("light", "fit"):
                        default = inner.get_default(call_default_factory=True)
                        assert getattr(value, key) == default, f"{name}.{key}"
            elif not field.is_required():
                assert value == field.get_default(call_default_factory=True), name

    def test_library_calls_have_the_same_defaults(self):
        config = one()
        baked = inspect.signature(bake).parameters
        assert baked["resolution"].default == config.transfer.resolution
        assert baked["supersampling"].default == config.transfer.supersampling
        assert baked["memory_budget"].default == config.memory_budget
        built = inspect.signature(CPCA.from_transfer).parameters
        cpca = one("representation=cpca").representation
        for key in ("num_clusters", "rank", "method"):
            assert built[key].default == getattr(cpca, key), key

    def test_help_lists_keys_and_stops(self, capsys):
        with pytest.raises(SystemExit) as stopped:
            parse("--help")
        assert stopped.value.code == 0
        shown = capsys.readouterr().out
        assert shown.startswith("usage: python train/fit.py")
        keys = OmegaConf.create(shown[shown.index("\nscene:") :])
        assert set(keys) == set(RunConfig.model_fields)


class TestOverrides:
    @pytest.mark.parametrize(
        ("written", "meant"),
        [
            ("bunny.obj", "bunny.obj"),
            ("my meshes/the bunny.obj", "my meshes/the bunny.obj"),
            ("/data/a-b_c.1/bunny:2@x+y%.obj", "/data/a-b_c.1/bunny:2@x+y%.obj"),
            ("'a=b.obj'", "a=b.obj"),
            ('"rank=2, bunny (1)#é.obj"', "rank=2, bunny (1)#é.obj"),
            (r"'it\'s.obj'", "it's.obj"),
            ("'1e3'", "1e3"),
            ("null", None),
        ],
    )
    def test_file_names(self, written, meant):
        assert one(f"scene.mesh={written}").scene.mesh == meant
        assert [c.scene.mesh for c in parse("-m", f"scene.mesh={written}", "seed=1,2")] == [
            meant
        ] * 2

    def test_one_key_leaves_the_others(self):
        plain, changed = one().model_dump(), one("fit.max_steps=3").model_dump()
        assert changed["fit"].pop("max_steps") == 3
        assert plain["fit"].pop("max_steps") != 3
        assert changed == plain

    def test_plus_and_tilde_of_hydra_are_understood(self):
        assert one("+seed=3").seed == one("++seed=3").seed == one("seed=3").seed == 3
        assert one("~seed").seed == RunConfig.model_fields["seed"].default

    def test_config_name(self):
        demo = load_config(CONFIGS, "demo", [])
        assert one("--config-name", "demo") == one("--config-name=demo") == demo
        assert demo != one()

    def test_representations_by_name_and_by_mapping(self):
        cpca = one("representation=cpca").representation
        assert one("representations=[cpca]").fitted == [cpca]
        several = one("representations=[cpca,{name:cpca,rank:2},{name: cpca, num_clusters: 9}]")
        assert several.fitted == [
            cpca,
            cpca.model_copy(update={"rank": 2}),
            cpca.model_copy(update={"num_clusters": 9}),
        ]

    @pytest.mark.parametrize("name", REPRESENTATIONS)
    def test_each_name_stands_for_its_file(self, name):
        single = one(f"representation={name}").representation
        assert single.name == name
        assert one(f"representations=[{name}]").fitted == [single]
        assert one(f"representations=[{{name: {name}}}]").fitted == [single]

    def test_without_representations_the_one_is_fitted(self):
        config = one("representation.rank=7")
        assert config.fitted == [config.representation]
        assert config.representation.rank == 7


class TestGrid:
    def test_product_in_order(self):
        grid = parse("-m", "representation.rank=1,2", "transfer.order=3", "seed=5,6,7")
        found = [(c.representation.rank, c.transfer.order, c.seed) for c in grid]
        assert found == [(rank, 3, seed) for rank in (1, 2) for seed in (5, 6, 7)]

    def test_ranges_choices_and_quoted_texts(self):
        assert [c.seed for c in parse("-m", "seed=range(2,8,2)")] == [2, 4, 6]
        meshes = [c.scene.mesh for c in parse("-m", "scene.mesh='a, b.obj','c=d.obj',e f.obj")]
        assert meshes == ["a, b.obj", "c=d.obj", "e f.obj"]
        assert [c.fit.optimizer for c in parse("-m", "fit=adam,lbfgs")] == ["adam", "lbfgs"]

    def test_lists_are_not_grids(self):
        assert [c.light.test for c in parse("-m", "light.test=[sky,sunset]")] == [["sky", "sunset"]]

    def test_one_wrong_point_refuses_all_before_any_is_run(self):
        assert refusal("-m", "representation.rank=1,2,0").startswith("representation.rank: ")

    def test_one_folder_for_several_runs(self):
        assert refusal("-m", "seed=1,2", "out=a").startswith("out: one folder cannot hold several")
        assert [c.out for c in parse("-m", "seed=1", "out=a,b")] == ["a", "b"]


class TestRefusals:
    @pytest.mark.parametrize(
        ("argument", "key", "choices"),
        [
            ("rank=3", "rank", "representation, representations, fit"),
            ("hydra.run.dir=x", "hydra.run.dir", "scene, material, light, transfer"),
            ("+more=3", "more", "scene, material, light, transfer"),
            ("scene@x=procedural", "scene@x", "scene, material, light, transfer"),
            ("representation.rang=3", "representation.rang", "name, num_clusters, rank, method"),
            ("+scene.colour=3", "scene.colour", "albedo"),
            ("representations=[{name:cpca,rang:3}]", "representations.0.rang", "rank"),
        ],
    )
    def test_unknown_key(self, argument, key, choices):
        message = refusal(argument)
        assert message.startswith(f"{key}: unknown key; expected one of ")
        assert choices in message

    @pytest.mark.parametrize(
        ("argument", "key", "expected"),
        [
            ("representation.rank=0", "representation.rank", "greater than or equal to 1, got 0"),
            ("representation.rank=two", "representation.rank", "valid integer"),
            ("representation.rank=1.5", "representation.rank", "valid integer"),
            ("representation.num_clusters=-4", "representation.num_clusters", "got -4"),
            ("transfer.order=0", "transfer.order", "greater than or equal to 1, got 0"),
            ("transfer.order=65", "transfer.order", "less than or equal to 64, got 65"),
            ("transfer.light_basis=fourier", "transfer.light_basis", "'sh'"),
            ("scene.up=x", "scene.up", "'y' or 'z', got 'x'"),
            ("scene.mesh=12", "scene.mesh", "valid string, got 12"),
            ("scene.ground=perhaps", "scene.ground", "valid boolean"),
            ("scene.ground_resolution=100000", "scene.ground_resolution", "2048"),
            ("scene.albedo=[0.5,0.5,1.5]", "scene.albedo.2", "less than or equal to 1, got 1.5"),
            ("scene.albedo=0.5", "scene.albedo", "valid tuple"),
            ("light.test=[]", "light.test", "at least 1 item"),
            ("light.test=sky", "light.test", "valid list, got 'sky'"),
            ("light.exposure=nan", "light.exposure", "finite number, got nan"),
            ("light.rotation_degrees=inf", "light.rotation_degrees", "finite number"),
            ("fit.optimizer=sgd", "fit.optimizer", "'lbfgs' or 'adam', got 'sgd'"),
            ("memory_budget=1000", "memory_budget", "16777216, got 1000"),
            ("seed=-1", "seed", "got -1"),
            ("cache=", "cache", "at least 1 character"),
            ("representations=cpca", "representations", "valid list, got 'cpca'"),
            ("representations=5", "representations", "valid list, got 5"),
            ("representations=[5]", "representations.0", "got 5"),
            ("~fit", "fit", "field required"),
            ("light=5", "light", "expected the name of a file in configs/light"),
        ],
    )
    def test_wrong_value(self, argument, key, expected):
        message = refusal(argument)
        assert message.startswith(f"{key}: ")
        assert expected in message

    def test_exit_functions_that_the_light_does_not_have(self):
        message = refusal("transfer=haar", "transfer.exit_basis=harmonics")
        assert message == "transfer: exit_basis=harmonics needs light_basis=sh, got haar"
        assert "'factors'" in refusal("transfer.exit_basis=wavelets")
        assert one("transfer=haar", "transfer.exit_basis=factors").transfer.exit_basis == "factors"

    @pytest.mark.parametrize("resolution", [3, 31])
    def test_bits_that_do_not_fill_bytes(self, resolution):
        message = refusal(f"transfer.resolution={resolution}", "transfer.supersampling=1")
        assert message == (
            f"transfer: resolution times supersampling must be even, got {resolution} times 1"
        )

    @pytest.mark.parametrize(
        ("argument", "start"),
        [
            ("representation=spca", "representation: unknown 'spca'"),
            ("representation.name=spca", "representation"),
            ("representations=[spca]", "representations: unknown 'spca'"),
            ("representations=[{name:spca}]", "representations.0"),
        ],
    )
    def test_unknown_representation_lists_the_known(self, argument, start):
        message = refusal(argument)
        assert start in message
        assert "spca" in message
        for name in REPRESENTATIONS:
            assert name in message

    def test_unknown_configuration_lists_the_known(self):
        for arguments in (["--config-name=fitt"], ["--config-name", "fitt"]):
            assert refusal(*arguments) == (
                f"--config-name=fitt: no such configuration; expected one of {', '.join(COMPLETE)}"
            )

    def test_unknown_option(self):
        assert refusal("--multi") == "--multi: unknown option; see --help"

    @pytest.mark.parametrize(
        "argument", ["scene.mesh=a=b.obj", "scene.mesh=a (1).obj", "scene.mesh", "bunny.obj", "a="]
    )
    def test_what_is_no_override_is_repeated_with_what_is(self, argument):
        message = refusal(argument)
        assert argument.rstrip("=") in message
        assert "unknown key" in message or "needs quotes of its own" in message

    def test_grid_without_its_option(self):
        assert refusal("seed=1,2").startswith("seed=1,2: several values; use -m for a grid")

    def test_several_mistakes_are_counted(self):
        assert refusal("seed=-1", "transfer.order=0", "fit.max_steps=-1").endswith("(and 2 more)")

    @pytest.mark.parametrize("file", ["mine", "representation/mine", "sweep/mine"])
    def test_yaml_that_cannot_be_read_is_one_line_with_its_place(self, tmp_path, file):
        configs = tmp_path / "configs"
        shutil.copytree(CONFIGS, configs)
        (configs / f"{file}.yaml").write_text("name: cpca\nname: cpca\n")
        calls = {
            "mine": [lambda: load_config(configs, "mine", [])],
            "representation/mine": [
                lambda: load_config(configs, "fit", ["representation=mine"]),
                lambda: load_config(configs, "fit", ["representations=[mine]"]),
            ],
            "sweep/mine": [lambda: parse_sweep(["sweep=mine"], configs, script="train/sweep.py")],
        }
        for call in calls[file]:
            with pytest.raises(InputError) as caught:
                call()
            place = f"{configs / file}.yaml, line 2, column 1: found duplicate key name"
            assert str(caught.value).endswith(place)
