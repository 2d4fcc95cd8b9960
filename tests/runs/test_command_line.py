"""The command line of training, as a user meets it: in a subprocess."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest
import yaml

from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError, EvaluateConfig, TrainConfig
from emrld_jax.runs.usage import leaves
from tests.conftest import Command

# argument, and what the message must say
REFUSED = [
    ("adpt.num_steps=2", ["adpt.num_steps", "did you mean 'adapt.num_steps'"]),
    ("max_kl=0.1", ["max_kl", "did you mean 'meta.max_kl'"]),
    ("env=pointd2d", ["env=pointd2d", "did you mean 'point2d'", "two_wheeled_drift"]),
    ("env.name=two_wheeled", ["env.name", "env=two_wheeled"]),
    ("algo=EMRLD", ["algo=EMRLD", "did you mean 'emrld'"]),
    ("--env", ["'--env'", "without dashes"]),
    ("algo=emrl", ["algo=emrl", "did you mean 'emrld'", "maml"]),
    ("adapt.warm_start_rate=0.1", ["has no effect with algo=emrld", "it is for emrld_ws"]),
    ("experiment=papr", ["experiment=papr", "did you mean 'paper'"]),
    ("policy.activation=tan", ["policy.activation", "tanh", "relu"]),
    ("env.reward=spars", ["env.reward", "sparse", "dense"]),
    ("meta.max_kl=-0.01", ["meta.max_kl", "above 0"]),
    ("meta.max_kl=nan", ["meta.max_kl", "above 0"]),
    ("adapt.num_episodes=0", ["adapt.num_episodes", "at least 1"]),
    ("adapt.num_episodes=2.5", ["adapt.num_episodes", "a whole number"]),
    ("adapt.first_order=maybe", ["adapt.first_order", "true or false"]),
    ("policy.hidden_sizes=[8,0]", ["policy.hidden_sizes", "at least 1"]),
    ("policy.hidden_sizes=[]", ["policy.hidden_sizes=[]", "policy.start_at_zero=false"]),
    ("policy={std: 1}", ["policy is a section", "policy.std"]),
    ("seed=1,2", ["seed=1,2", "one value at a time"]),
    ("+seed=1", ["+seed=1", "setting=value"]),
    ("seed", ["'seed'", "setting=value"]),
    ("demos=perfect", ["demos", "perfect", "optimal", "suboptimal"]),
    ("demos=/nowhere/lines.npz", ["/nowhere/lines.npz", "no such file"]),
    ("resume=", ["resume=", "must not be empty"]),
    ("demos=null", ["demos=null", "a text"]),
    ("env.horizon=1000000000", ["env.horizon=1000000000", "at most 100000"]),
    ("adapt.num_episodes=1000000", ["adapt.num_episodes=1000000", "at most 10000"]),
    ("runs=/proc/nope", ["runs=/proc/nope", "must be a folder"]),
    ("runs=/etc/passwd", ["runs=/etc/passwd", "must be a folder"]),
    ("vmap.w_bc=0.5", ["vmap.w_bc=0.5", "list of numbers"]),
    ("vmap.w_bc=[0.5,a]", ["vmap.w_bc", "list of numbers"]),
    ("vmap.w_bc=[]", ["vmap.w_bc=[]", "list of numbers"]),
    ("vmap.w_bc=[0.5,0.5]", ["vmap.w_bc", "given twice"]),
    ("vmap.w_bc=[0.5,-1]", ["w_bc=-1.0", "at least 0"]),
    ("vmap.max_kl=[0.1,0.2]", ["no setting 'max_kl'", "did you mean 'meta.max_kl'"]),
    ("vmap.adapt.num_steps=[1,2]", ["adapt.num_steps cannot differ", "emrld_jax.sweep"]),
    ("vmap.policy.activation=[tanh,relu]", ["policy.activation cannot differ", "w_rl"]),
    ("vmap.adapt.warm_start_rate=[0.1,0.2]", ["has no effect with algo=emrld"]),
    ("num_seeds=0", ["num_seeds=0", "at least 1"]),
    ("devices=0", ["devices=0", "at least 1, or all"]),
    ("devices=some", ["devices=some", "or all"]),
    ("devices=2", ["2 devices cannot share 1 run(s) of 3 tasks", "these numbers can: 1, 3"]),
    ("processes=1000", ["processes=1000", "core(s)"]),
    ("distributed.num_processes=2", ["num_processes=2", "distributed.coordinator=HOST:PORT"]),
    ("distributed.process_id=1", ["process_id=1", "below distributed.num_processes=1"]),
    ("distributed.coordinator=here:1", ["num_processes=1", "distributed.coordinator=null"]),
    ("resume=/nowhere", ["/nowhere", "no such run folder"]),
    ("resume=/etc/ssl", ["/etc/ssl", "not a run folder"]),
]


@pytest.mark.parametrize(("argument", "said"), REFUSED, ids=[argument for argument, _ in REFUSED])
def test_a_bad_argument_ends_before_any_work(
    command: Command, demos: Path, tmp_path: Path, argument: str, said: list[str]
) -> None:
    runs = tmp_path / "runs"
    key = argument.partition("=")[0]
    others = {"demos": f"demos={demos}", "runs": f"runs={runs}"}
    done = command("train", *(text for name, text in others.items() if name != key), argument)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.strip().splitlines()) == 1
    for words in said:
        assert words in done.stderr
    assert done.stdout == ""
    assert not runs.exists()


def test_demonstrations_of_another_environment_are_refused(
    command: Command, demos: Path, tmp_path: Path
) -> None:
    done = command("train", "env=two_wheeled", f"demos={demos}", f"runs={tmp_path / 'runs'}")
    assert done.returncode == 2
    assert "demonstrations of point2d cannot teach two_wheeled" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()


def test_train_help_tells_of_every_setting_and_group(command: Command) -> None:
    done = command("train", "--help")
    assert done.returncode == 0
    for key, leaf in leaves(TrainConfig()).items():
        if key != "env.name":  # chosen by env=NAME
            assert f"\n  {key}=" in done.stdout
            assert leaf.metadata["help"].split()[0] in done.stdout
    for words in ("env=NAME", "point2d", "two_wheeled_drift", "experiment=NAME", "paper"):
        assert words in done.stdout


def test_help_shows_the_values_that_the_other_arguments_give(command: Command) -> None:
    done = command("train", "env=two_wheeled", "seed=7", "--help")
    assert done.returncode == 0
    tuned = yaml.safe_load((cli.CONF / "env" / "two_wheeled.yaml").read_text())
    std, max_kl = tuned["policy"]["std"], tuned["meta"]["max_kl"]
    for line in ("  seed=7", f"  policy.std={std}", f"  meta.max_kl={max_kl}"):
        assert line in done.stdout.splitlines()


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 bytes\nmore"), 1, "env.horizon"),
        (MemoryError(), 1, "memory ran out"),
        (PermissionError(13, "Permission denied", "/x"), 2, "/x"),
    ],
)
def test_what_a_machine_refuses_is_one_message(
    error: Exception,
    code: int,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail() -> int:
        raise error

    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/unused")  # so that none is configured
    with pytest.raises(SystemExit) as ended:
        cli.run_command(fail)
    assert ended.value.code == code
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]


def test_a_setting_given_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="seed=2: seed is given twice"):
        cli.train_config(["seed=1", "seed=2"])


def test_null_is_no_file_name() -> None:
    assert cli.train_config(["resume=null"]).resume is None


def test_evaluate_help_tells_of_every_setting(command: Command) -> None:
    done = command("evaluate", "--help")
    assert done.returncode == 0
    assert all(f"\n  {key}=" in done.stdout for key in leaves(EvaluateConfig()))


def test_all_documented_overrides_together() -> None:
    config = cli.train_config(
        [
            *("env=two_wheeled", "algo=emrld_ws", "demos=suboptimal", "seed=3", "w_rl=0.3"),
            *("meta.max_kl=0.02", "meta.iterations=7", "adapt.num_steps=2"),
            *("adapt.num_episodes=5", "adapt.learning_rate=0.02", "env.reward=dense"),
            "policy.hidden_sizes=[8,4]",
        ]
    )
    assert (config.env.name, config.env.reward) == ("two_wheeled", "dense")
    assert (config.algo, config.demos, config.seed) == ("emrld_ws", "suboptimal", 3)
    assert (config.meta.max_kl, config.meta.iterations, config.w_rl) == (0.02, 7, 0.3)
    assert (config.adapt.num_steps, config.adapt.num_episodes) == (2, 5)
    assert (config.adapt.learning_rate, config.policy.hidden_sizes) == (0.02, [8, 4])


@pytest.mark.parametrize("env", cli.groups()["env"])
def test_the_paper_preset_overrides_tuned_defaults(env: str) -> None:
    config = cli.train_config([f"env={env}", "experiment=paper"])
    preset = yaml.safe_load((cli.CONF / "experiment" / "paper.yaml").read_text())
    tuned = yaml.safe_load((cli.CONF / "env" / f"{env}.yaml").read_text())
    for section in ("policy", "adapt", "meta"):
        assert set(tuned[section]) - {"iterations"} <= set(preset[section])
    assert (config.policy.start_at_zero, config.policy.output_scale) == (False, 1.0)
    assert (config.meta.fisher_every, config.meta.max_backtracks) == (1, 15)
    assert config.adapt.warm_start_rate == 0.01
    assert (config.policy.activation, config.policy.hidden_sizes) == ("relu", [100, 100])
    assert (config.policy.std, config.policy.learn_std) == (0.5, False)
    assert (config.adapt.num_steps, config.adapt.num_episodes) == (1, 20)
    assert (config.adapt.learning_rate, config.adapt.first_order) == (0.01, False)
    assert (config.adapt.discount, config.adapt.gae_lambda) == (0.95, 1.0)
    assert (config.meta.max_kl, config.meta.backtrack_ratio) == (0.01, 0.5)
    assert (config.meta.cg_iterations, config.meta.damping) == (10, 1e-5)
    assert (config.w_rl, config.w_bc) == (None, 1.0)


def test_arguments_win_over_the_preset() -> None:
    config = cli.train_config(["policy.activation=silu", "experiment=paper"])
    assert config.policy.activation == "silu"


@pytest.mark.parametrize(
    "path", ["a b.npz", "x=1,y=[2].npz", "it's.npz", "(1)/über.npz", "${x}", "'\""]
)
def test_a_path_is_taken_as_it_is(path: str) -> None:
    assert cli.train_config([f"demos={path}"]).demos == path
