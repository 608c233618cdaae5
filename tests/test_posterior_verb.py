"""Posteriors of logs: agreement with least squares, held-out bands, files, and the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from terminal import Cli

from sysid_btr.errors import UsageError
from sysid_btr.estimators import Budget
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.optional import optional
from sysid_btr.posterior.draw import posterior
from sysid_btr.posterior.outcome import Posterior
from sysid_btr.posterior.sampling import Settings
from sysid_btr.result import read_result

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
LEG_FIT = ("mass:HipPitch,KneePitch,HipRoll", "kp:*=shared")
QUICK = Settings(draws=400.0, fewest_steps=25, substeps=10)


@pytest.fixture(scope="module")
def leg() -> Posterior:
    log = read_log(SAMPLES / "leg_clean.parquet")
    short = log.window(0, int(np.searchsorted(log.time, log.time[0] + 4.0)))
    study = make_study(load_robot(str(SAMPLES / "leg.xml")), [short], threads=1)
    return posterior(fit(study, LEG_FIT), settings=QUICK, rng=np.random.default_rng(3))


def test_a_posterior_agrees_with_least_squares(leg: Posterior) -> None:
    assert leg.converged
    truth = json.loads((SAMPLES / "leg_clean.truth.json").read_text())
    known = {
        "mass:HipPitch": truth["mass"]["HipPitch"]["scale"],
        "mass:KneePitch": truth["mass"]["KneePitch"]["scale"],
        "kp:*": truth["kp"]["KneePitch"]["scale"],
    }
    for own, squares in zip(leg.estimates, leg.fit.estimates, strict=True):
        if own.name not in known:
            continue
        assert own.identifiable == squares.identifiable == "yes"
        assert abs(own.value - squares.value) < 0.4 * squares.std
        assert own.std == pytest.approx(squares.std, rel=0.2)
        assert own.ci95[0] <= known[own.name] <= own.ci95[1]


def test_what_the_log_cannot_tell_stays_as_it_was_believed(leg: Posterior) -> None:
    [hip] = [e for e in leg.estimates if e.name == "mass:HipRoll"]
    assert hip.identifiable == "no"
    assert hip.reason
    assert hip.std == pytest.approx(2.7 / np.sqrt(12), rel=0.1)
    learnt = dict(zip((e.name for e in leg.estimates), leg.learnt, strict=True))
    assert learnt["mass:HipRoll"] == pytest.approx(1.0, abs=0.1)
    assert learnt["kp:*"] < 0.05


def test_the_surrogate_was_good_and_says_so(leg: Posterior) -> None:
    assert leg.sample.surrogate.acceptance > 0.9
    assert leg.sample.surrogate.error < 0.2


def test_every_draw_was_replayed(leg: Posterior) -> None:
    problem = leg.study.train_problem(leg.fit.model.terms)
    which = np.arange(0, len(leg.sample.flat), 97)
    loss = problem.loss(leg.sample.flat[which])
    u = leg.likelihood.box.enter(leg.sample.flat[which])
    np.testing.assert_allclose(
        leg.sample.log_likelihood.reshape(-1)[which], leg.likelihood.log(u, loss), rtol=1e-6, atol=1e-6
    )


def test_held_out_data_lie_in_their_bands(leg: Posterior) -> None:
    assert leg.coverage["position"] == pytest.approx(0.95, abs=0.03)
    for band in leg.bands:
        assert np.all(band.half_width[band.held_out] >= 1.9 * band.error)
        assert not band.held_out[: len(band.time) // 2].any()


def short_log() -> Log:
    """Half of a sample log: draws cost as many replays, of half the length."""
    return read_log(SAMPLES / "pendulum_clean.parquet").window(0, 500)


@pytest.fixture(scope="module")
def pendulum() -> Fit:
    study = make_study(load_robot(str(SAMPLES / "pendulum.xml")), [short_log()], threads=1)
    return fit(study, ("mass:*", "kp:*"))


def test_a_prior_that_contradicts_the_log_pulls(pendulum: Fit) -> None:
    squares = pendulum.estimates[1]
    belief = f"normal({squares.value + 2 * squares.std}, {squares.std})"
    pulled = posterior(pendulum, priors={"kp": belief}, settings=QUICK, rng=np.random.default_rng(0))
    own = pulled.estimates[1]
    assert own.value == pytest.approx(squares.value + squares.std, abs=0.4 * squares.std)
    assert own.std == pytest.approx(squares.std / np.sqrt(2), rel=0.25)


def test_the_robots_table_is_asked_for_priors(pendulum: Fit) -> None:
    squares = pendulum.estimates[0]
    sure = replace(pendulum.study.robot, priors={"mass": f"normal({squares.value}, {0.1 * squares.std})"})
    told = posterior(
        replace(pendulum, study=replace(pendulum.study, robot=sure)),
        settings=Settings(draws=200.0, fewest_steps=15, substeps=10),
        rng=np.random.default_rng(0),
    )
    assert told.estimates[0].std == pytest.approx(0.1 * squares.std, rel=0.25)


def test_a_posterior_as_a_datatree(leg: Posterior) -> None:
    from sysid_btr.posterior.export import to_datatree

    tree = to_datatree(leg)
    values = tree["posterior"]["mass:HipPitch"]
    ensembles, steps, walkers, _ = leg.sample.draws.shape
    assert values.dims == ("chain", "draw")
    assert values.shape == (ensembles * walkers, steps)
    np.testing.assert_array_equal(values.values[walkers + 1], leg.sample.draws[1, :, 1, 0])
    assert list(tree["posterior"]["ensemble"].values) == [e for e in range(ensembles) for _ in range(walkers)]
    assert values.attrs["units"] == "1"
    np.testing.assert_array_equal(tree["sample_stats"]["lp"].values[0], leg.sample.log_density[0, :, 0])


def test_a_datatree_has_what_was_observed_beside_what_is_predicted(leg: Posterior) -> None:
    from sysid_btr.posterior.export import to_datatree

    tree = to_datatree(leg)
    band = leg.bands[3]
    name = f"{band.channel}.{band.joint}"
    observed, predicted = tree["observed_data"][name], tree["posterior_predictive"][name]
    np.testing.assert_array_equal(observed.values, band.measured[band.held_out])
    np.testing.assert_array_equal(observed[f"time_{name}"].values, band.time[band.held_out])
    assert predicted.dims == ("chain", "draw", *observed.dims)
    # replicates scatter as the band says, and the replays among them as the draws do
    spread = predicted.values[0].std(axis=0)
    expected = np.hypot(band.spread, band.error)[band.held_out]
    assert np.median(spread / expected) == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(band.draws.mean(axis=0), band.mean, atol=1e-6)


def test_figures_are_drawn_on_axes(leg: Posterior) -> None:
    from sysid_btr.report.posterior import plot_bands, plot_corner, plot_trace
    from sysid_btr.report.style import png

    count = len(leg.estimates)
    corner = plot_corner(leg)
    assert corner.shape == (count, count)
    assert png(corner[0, 0].figure).startswith(b"\x89PNG")
    assert len(plot_trace(leg)) >= count
    assert len(plot_bands(leg)) == 2 * min(len(leg.bands), 3)


def test_the_posterior_of_a_single_parameter_is_drawn_with_the_fit() -> None:
    from sysid_btr.report.posterior import plot_corner

    draws = np.random.default_rng(0).normal(1.2, 0.1, size=(400, 1))
    single = SimpleNamespace(
        estimates=[None],
        sample=SimpleNamespace(flat=draws, names=("mass:arm",)),
        fit=SimpleNamespace(values=np.array([1.2])),
    )
    [[axis]] = plot_corner(single)
    assert any(set(line.get_xdata()) == {1.2} for line in axis.lines)


# --- the command line -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("log") / "short.parquet"
    write_log(short_log(), path)
    return str(path)


@pytest.fixture(scope="module")
def asked(log_file: str) -> tuple[str, ...]:
    return (
        *("--model", str(SAMPLES / "pendulum.xml"), "--log", log_file),
        *("--fit", "mass:*", "--fit", "kp:*", "--threads", "1", "--priors", "kp=normal(1, 0.5)"),
    )


def test_the_verb_writes_everything_and_resumes(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    import xarray

    out = tmp_path / "o"
    answer = cli("posterior", *asked, "--out", out)
    assert answer.code == 0, answer.err
    files = {"result.json", "posterior.nc", "corner.png", "trace.png", "predictive.png", "report.html", "journal.jsonl"}
    assert files <= {f.name for f in out.iterdir()}
    result = read_result(out)
    assert result["kind"] == "posterior"
    assert result["converged"] is True
    assert result["sampling"]["ensembles"] == 2
    assert result["sampling"]["autocorrelation_times"] >= 50
    assert result["sampling"]["rhat"] < 1.01
    assert result["surrogate"]["acceptance"] > 0.9
    assert 0.9 < result["predictive"]["position"]["coverage95"] <= 1
    by_name = {p["name"]: p for p in result["parameters"]}
    assert by_name["mass:arm"]["ci95"][0] < 1.1 < by_name["mass:arm"]["ci95"][1]
    assert by_name["mass:arm"]["prior"] == "uniform"
    assert by_name["kp:pendulum"]["prior"] == "normal(1, 0.5)"
    assert by_name["kp:pendulum"]["least_squares"]["std"] > 0
    assert "mass:arm" in answer.out
    with xarray.open_datatree(out / "posterior.nc", engine="h5netcdf") as tree:
        stored = tree["posterior"]["mass:arm"].values
        assert stored.mean() == pytest.approx(by_name["mass:arm"]["value"])
        assert tree.attrs["converged"] == 1
    journal = out / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    again = tmp_path / "again"
    again.mkdir()
    (again / journal.name).write_bytes(b"".join(lines[: len(lines) // 2]))
    for array in out.glob("journal.jsonl.*.npy"):
        (again / array.name).write_bytes(array.read_bytes())
    resumed = cli("posterior", *asked, "--out", again, "--resume", "--json")
    assert resumed.code == 0, resumed.err
    assert json.loads(resumed.out)["parameters"] == result["parameters"]
    other = cli("posterior", *asked, "--out", out, "--resume", "--ensembles", "3")
    assert other.code == 2
    assert "another fit" in other.err


def test_a_budget_that_is_out_is_written_and_exits_5(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    out = tmp_path / "o"
    answer = cli("posterior", *asked, "--out", out, "--max-evaluations", "150")
    assert answer.code == 5
    result = read_result(out)
    assert result["converged"] is False
    assert "budget" in result["termination"]
    assert result["sampling"]["replays"] == 150
    assert (out / "posterior.nc").is_file()
    assert "did not converge" in answer.out


def test_a_budget_too_small_for_one_draw_exits_5(cli: Cli, asked: tuple[str, ...]) -> None:
    answer = cli("posterior", *asked, "--max-evaluations", "20")
    assert answer.code == 5
    assert "replays a step" in answer.err


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (("--priors", "kp=gauss(1, 2)"), "gauss"),
        (("--priors", "kv=normal(1, 2)"), "kv is not a fitted parameter"),
        (("--priors", "kp"), "--priors"),
        (("--walkers", "7"), "even"),
        (("--ensembles", "1"), "--ensembles"),
    ],
    ids=" ".join,
)
def test_mistakes_are_told_before_the_work(cli: Cli, asked: tuple[str, ...], argv: tuple[str, ...], said: str) -> None:
    answer = cli("posterior", *asked, *argv)
    assert answer.code == 2
    assert said in answer.err


def test_a_missing_package_is_named_with_its_extra(
    cli: Cli, asked: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("sysid_btr.optional.find_spec", lambda name: None if name == "corner" else find_spec(name))
    answer = cli("posterior", *asked, "--out", tmp_path / "o")
    assert answer.code == 2
    assert "sysid-btr[posterior]" in answer.err
    assert not (tmp_path / "o").exists()


def test_only_the_missing_package_itself_is_blamed(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_name: str) -> Any:
        raise ModuleNotFoundError("No module named 'numby'", name="numby")

    monkeypatch.setattr("sysid_btr.optional.import_module", broken)
    with pytest.raises(ModuleNotFoundError):
        optional("corner", "posterior", "the corner plot")
    monkeypatch.undo()
    with pytest.raises(UsageError, match="nowhere_at_all"):
        optional("nowhere_at_all", "posterior", "this")


def test_priors_and_settings_from_a_study_file(cli: Cli, log_file: str, tmp_path: Path) -> None:
    study = tmp_path / "study.toml"
    study.write_text(
        f"""
        model = "{SAMPLES / "pendulum.xml"}"
        log = "{log_file}"
        fit = ["mass:*", "kp:*"]
        threads = 1
        json = true
        max_evaluations = 160
        ensembles = 3
        walkers = 10
        [priors]
        "mass" = "lognormal(1, 0.3)"
        "kp:pendulum" = "normal(1, 0.1)"
        """
    )
    answer = cli("posterior", "--config", study)
    assert answer.code == 5, answer.err
    result = json.loads(answer.out)
    assert [p["prior"] for p in result["parameters"]] == ["lognormal(1, 0.3)", "normal(1, 0.1)"]
    assert (result["sampling"]["ensembles"], result["sampling"]["walkers"]) == (3, 10)


def test_profiles_of_a_fit(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    out = tmp_path / "o"
    fitted = asked[: asked.index("--priors")]
    answer = cli("fit", *fitted, "--profile", "mass:*", "--out", out)
    assert answer.code == 0, answer.err
    assert (out / "profile_mass_arm.png").read_bytes().startswith(b"\x89PNG")
    [entry] = read_result(out)["profiles"]
    assert entry["name"] == "mass:arm"
    assert entry["ci95"][0] < 1.1 < entry["ci95"][1]
    assert entry["closed"] == [True, True]
    wrong = cli("fit", *fitted, "--profile", "mas:arm")
    assert wrong.code == 2
    assert "mass:arm" in wrong.err


def test_a_budget_is_the_samplers_alone(pendulum: Fit) -> None:
    few = posterior(pendulum, budget=Budget(evaluations=120), rng=np.random.default_rng(0))
    assert not few.converged
    assert few.sample.evaluations == 120
