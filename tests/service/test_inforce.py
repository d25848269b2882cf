"""Calibrations in force: rules, decisions, history, and the calibration that applies to a frame."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from reseau.archive import Archive
from reseau.calibration import Calibration
from reseau.calibration.document import Covariance, Quantity
from reseau.cli import run
from reseau.core.errors import FormatError, UsageError
from reseau.service import AcceptanceRules, Configurations, Limits, judge
from reseau.service.explaining import RunHistory, explain_runs
from reseau.service.fields import difference

START = datetime(2026, 3, 2, 8, 0, tzinfo=UTC)
RULES = AcceptanceRules(version=1, image=Limits(warning=0.1, action=0.4))
FIRST = {"c": 8.0, "x0": 0.02, "y0": -0.01, "K1": 1e-3}
SIGMA = {"c": 1e-4, "x0": 1e-4, "y0": 1e-4, "K1": 2e-6}


def day(number: float) -> datetime:
    return START + timedelta(days=number)


def camera(*, size: tuple[int, int] = (640, 480), redundancy: int = 400, codes: tuple[str, ...] = (),
           extent: tuple[float, ...] = (10.0, 10.0, 630.0, 470.0), scale: float = 1.0, name: str = "left",
           begun: datetime | None = None, **values: float) -> Calibration:  # fmt: skip
    sigma = {key: scale * value for key, value in SIGMA.items()}
    matrix = tuple(tuple(sigma[a] ** 2 if a == b else 0.0 for b in SIGMA) for a in SIGMA)
    return Calibration(
        kind="camera", name=name, sigma0=1.0, redundancy=redundancy,
        model={"model": "brown", "width": size[0], "height": size[1], "pitch_mm": [0.01, 0.01]},
        parameters={
            key: Quantity(value=value, sigma=sigma[key], unit="mm^-2" if key == "K1" else "mm")
            for key, value in (FIRST | values).items()
        },
        covariance=Covariance(names=tuple(SIGMA), matrix=matrix),
        validity={"extent": list(extent), "unit": "px", "warning_codes": list(codes)},
        times={} if begun is None else {"begun": begun.isoformat()},
    )  # fmt: skip


@pytest.fixture
def archive(opened: Callable[[], Archive]) -> Iterator[Archive]:
    with opened() as made:
        yield made


def opencv_camera(fx: float = 800.0, k1: float = 0.064) -> Calibration:
    """The camera of `FIRST` in another model: fx = c / 0.01 mm, k1 = K1 c²."""
    values = {"fx": fx, "fy": fx, "cx": 321.5, "cy": 238.5, "k1": k1}
    sigma = {"fx": 0.02, "fy": 0.02, "cx": 0.02, "cy": 0.02, "k1": 1e-4}
    matrix = tuple(tuple(sigma[a] ** 2 if a == b else 0.0 for b in sigma) for a in sigma)
    return camera(name="converted").model_copy(
        update={
            "model": {"model": "opencv", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01]},
            "parameters": {
                n: Quantity(value=v, sigma=sigma[n], unit="1" if n == "k1" else "px")
                for n, v in values.items()
            },
            "covariance": Covariance(names=tuple(sigma), matrix=matrix),
        }
    )


def test_calibrations_of_another_model_are_converted_and_the_error_is_reported(archive: Archive) -> None:
    known, _ = started(archive)
    made = known.decide("left", opencv_camera(), RULES, since=day(7))
    told = {each.rule: each for each in made.judgement.findings}
    assert told["model"].text.startswith("brown in force, opencv now: converted with an error of at most")
    assert told["model"].value < 0.01
    assert made.outcome.startswith("accepted")
    drift = known.drift("left")
    assert drift.names[:5] == ("fx", "fy", "cx", "cy", "k1")
    # The converted first calibration: c / pitch, and K1 c².
    assert drift.values[0, 0] == pytest.approx(800.0, abs=0.05)
    assert drift.values[0, 4] == pytest.approx(0.064, abs=1e-4)
    assert 0 < drift.conversion_px < 0.01


def started(archive: Archive) -> tuple[Configurations, str]:
    """A configuration with a first calibration in force."""
    known = Configurations(archive)
    known.define("left", {"camera": "DMK 33", "lens": "8 mm f/8"})
    first = known.decide("left", camera(), RULES, since=START, by="test")
    known.review("left", first.key, "accepted", by="Ada", comment="first")
    return known, first.key


@pytest.mark.parametrize(
    ("new", "outcome", "rule"),
    [
        (camera(), "accepted", None),
        (camera(c=8.001), "accepted with warning", "significance"),
        (camera(c=8.0005, scale=5.0), "accepted", None),
        (camera(c=8.005), "accepted with warning", "image"),
        (camera(c=8.05), "rejected", "image"),
        (camera(c=8.012, scale=60.0), "needs review", "resolution"),
        (camera(scale=1500.0), "needs review", "resolution"),
        (camera(redundancy=3), "rejected", "redundancy"),
        (camera(extent=(200.0, 10.0, 500.0, 470.0)), "rejected", "coverage"),
        (camera(codes=("weak-geometry",)), "rejected", "warnings"),
        (camera(codes=("correlated",)), "accepted with warning", "warnings"),
    ],
)
def test_outcomes_follow_from_size_significance_and_completeness(
    new: Calibration, outcome: str, rule: str | None
) -> None:
    judged = judge(new, camera(), RULES)
    assert judged.outcome == outcome, judged.findings
    if rule is not None:
        assert rule in {each.rule for each in judged.findings if each.level != "ok"}
    else:
        assert all(each.level == "ok" for each in judged.findings)
    assert AcceptanceRules.from_content(dict(judged.rules), where="rules") == RULES


@pytest.mark.slow
def test_the_congruence_test_keeps_its_level_with_the_covariances_of_both() -> None:
    rng, found = np.random.default_rng(1), []
    for _ in range(400):
        old, new = (
            camera(**{key: FIRST[key] + SIGMA[key] * rng.normal() for key in SIGMA}) for _ in range(2)
        )
        found.append(difference(new, old).p < 0.05)
    # Three standard deviations of a binomial count.
    assert np.mean(found) == pytest.approx(0.05, abs=3 * np.sqrt(0.05 * 0.95 / 400))


def test_the_difference_in_object_space_is_that_of_the_directions() -> None:
    found = difference(camera(c=8.008), camera())
    # A principal distance longer by 1e-3 moves the corner, 0.5 from the axis, by about 5e-4 in direction.
    assert found.by_distance == pytest.approx(found.greatest * 0.01 / 8.0, rel=0.1)
    rules = RULES.model_copy(update={"object": Limits(warning=0.1, action=0.2), "distance_mm": 1000.0})
    judged = judge(camera(c=8.004), camera(), rules)
    assert {each.rule: each.level for each in judged.findings}["object"] == "action"
    assert judged.outcome == "rejected"


def test_calibrations_of_different_models_are_compared_as_fields() -> None:
    other = Calibration(
        kind="camera", name="cv", sigma0=1.0, redundancy=400,
        model={"model": "opencv", "width": 640, "height": 480, "pitch_mm": [1.0, 1.0]},
        parameters={key: Quantity(value=v, sigma=0.01, unit="px")
                    for key, v in {"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5}.items()},
        covariance=Covariance(names=("fx", "fy"), matrix=((1e-4, 0.0), (0.0, 1e-4))),
    )  # fmt: skip
    assert difference(other, camera(K1=0.0, x0=0.0, y0=0.0)).greatest < 1e-6
    assert difference(other, camera()).greatest > 1.0


def test_calibrations_of_different_instruments_are_refused() -> None:
    with pytest.raises(UsageError, match="640×480 and 320×240"):
        judge(camera(size=(320, 240), extent=(5, 5, 315, 235)), camera(), RULES)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"image": {"warning": 0.4, "action": 0.1}}, "`image.action` is below `image.warning`"),
        ({"image": {"warning": 0.0, "action": 0.1}}, "image.warning"),
        ({"object": {"warning": 0.1, "action": 0.2}}, "must be given together"),
        ({"significance": {"warning": 0.001, "action": 0.01}}, "above `significance.warning`"),
    ],
)
def test_contradictory_rules_are_refused(change: dict[str, object], part: str) -> None:
    with pytest.raises(FormatError, match=part):
        AcceptanceRules.from_content(RULES.to_dict() | change, where="rules.json")


def test_the_calibration_of_a_frame_is_the_one_in_force_at_its_time(archive: Archive) -> None:
    known, first = started(archive)
    second = known.decide("left", camera(c=8.001), RULES, since=day(7), by="schedule")
    rejected = known.decide("left", camera(c=8.2), RULES, since=day(14))
    assert (second.outcome, rejected.outcome) == ("accepted with warning", "rejected")
    assert known.applied("left", day(-0.01)) is None
    applied = [known.applied("left", day(d)) for d in (0, 6.99, 7, 20)]
    assert [each.key for each in applied if each] == [first, first, second.key, second.key]
    assert applied[2] is not None
    assert applied[2].calibration == camera(c=8.001)
    assert second.compared_with == first


def test_what_was_believed_at_an_earlier_time_is_answered(archive: Archive) -> None:
    known, first = started(archive)
    before = datetime.now(UTC)
    second = known.decide("left", camera(c=8.001), RULES, since=day(7))
    now, then = known.applied("left", day(8)), known.applied("left", day(8), known=before)
    assert now is not None
    assert then is not None
    assert (now.key, then.key) == (second.key, first)


def test_a_return_replaces_all_that_apply_later_and_the_history_stays(archive: Archive) -> None:
    known, first = started(archive)
    second = known.decide("left", camera(c=8.001), RULES, since=day(7))
    third = known.decide("left", camera(c=8.002), RULES, since=day(14))
    applied = known.roll_back("left", first, since=day(10), by="Ada", comment="window was dirty")
    assert (applied.key, applied.why) == (first, "return")
    keys = [getattr(known.applied("left", day(d)), "key", None) for d in (8, 10, 15)]
    assert keys == [second.key, first, first]
    assert [d.key for d in known.history("left")] == [first, second.key, third.key]
    fourth = known.decide("left", camera(c=8.0001), RULES, since=day(21))
    assert fourth.compared_with == first
    bad = known.decide("left", camera(c=8.2), RULES, since=day(28))
    with pytest.raises(UsageError, match="was not accepted"):
        known.roll_back("left", bad.key)


def test_comments_never_change_an_outcome(archive: Archive) -> None:
    known, _ = started(archive)
    bad = known.decide("left", camera(c=8.2), RULES, since=day(7))
    after = known.comment("left", bad.key, "accepted", by="Bo")
    assert (after.outcome, after.comments) == ("rejected", (("Bo", "accepted"),))
    with pytest.raises(UsageError, match="is rejected and needs no review"):
        known.review("left", bad.key, "accepted", comment="please")


def test_a_review_is_made_once_and_with_a_reason(archive: Archive) -> None:
    known, first = started(archive)
    assert known.decision("left", first).reviewed_by == "Ada"
    with pytest.raises(UsageError, match="needs no review"):
        known.review("left", first, "rejected", comment="changed my mind")
    open_one = known.decide("left", camera(scale=1500.0), RULES, since=day(7))
    with pytest.raises(UsageError, match="needs a reason"):
        known.review("left", open_one.key, "accepted", comment=" ")
    assert known.review("left", open_one.key, "rejected", comment="too weak").outcome == "rejected"


def test_a_review_is_made_by_a_second_person_where_the_rules_ask_for_one(archive: Archive) -> None:
    known, _ = started(archive)
    strict = RULES.model_copy(update={"version": 7, "second_person": True})
    for number, by in enumerate(("Ada", "Ada, recalibration left")):
        known.event("left", "camera dropped", at=day(8 + 2 * number))
        made = known.decide("left", camera(c=8.0 + 1e-3 * number), strict, since=day(9 + 2 * number), by=by)
        with pytest.raises(UsageError, match="needs another person than Ada"):
            known.review("left", made.key, "accepted", by="Ada", comment="as expected")
        assert known.review("left", made.key, "accepted", by="Grace", comment="agreed").reviewed_by == "Grace"


def test_after_a_service_event_nothing_applies_until_the_next_calibration(archive: Archive) -> None:
    known, first = started(archive)
    known.event("left", "lens changed", at=day(5))
    before, after = known.applied("left", day(4)), known.applied("left", day(6))
    assert before is not None
    assert before.key == first
    assert after is None
    new = known.decide("left", camera(c=8.3), RULES, since=day(6))
    assert (new.outcome, new.compared_with) == ("needs review", None)
    assert known.events("left") == [(day(5), "lens changed")]


def test_the_same_calibration_is_judged_once(archive: Archive) -> None:
    known, _ = started(archive)
    one = known.decide("left", camera(c=8.001), RULES, since=day(7))
    assert known.decide("left", camera(c=8.001), RULES, since=day(9)) == one
    assert len(known.history("left")) == 2


def test_a_calibration_is_judged_again_by_other_rules_and_its_history_is_kept(archive: Archive) -> None:
    known, first = started(archive)
    strict = RULES.model_copy(update={"version": 2, "redundancy": 100_000})
    loose = RULES.model_copy(update={"version": 3})
    new = camera(c=8.0001)

    def applied() -> str:
        found = known.applied("left", day(8))
        assert found is not None
        return found.key

    key = known.decide("left", new, RULES, since=day(7)).key
    assert applied() == key
    made = known.decide("left", new, strict, since=day(9))
    assert (made.outcome, made.since, applied()) == ("rejected", day(7), first)
    made = known.decide("left", new, loose, by="Bob")
    assert (made.outcome, made.by, made.compared_with, applied()) == ("accepted", "Bob", first, key)
    assert [(each.outcome, each.rules["version"]) for _, _, each in made.earlier] == [
        ("accepted", 1), ("rejected", 2),
    ]  # fmt: skip
    # What a person decided is decided again where the new rules leave it open.
    open_rules = RULES.model_copy(update={"version": 4, "image": Limits(warning=1e-3, action=1e-3)})
    assert known.decide("left", new, open_rules).outcome == "needs review"
    assert applied() == first
    assert known.review("left", key, "accepted", by="Ada", comment="sound").reviewed_by == "Ada"
    assert applied() == key
    assert known.decide("left", new, loose.model_copy(update={"version": 5})).reviewed_by == ""
    assert len(known.history("left")) == 2


def test_rules_that_changed_need_a_new_version(archive: Archive) -> None:
    known, _ = started(archive)
    changed = RULES.model_copy(update={"redundancy": 20})
    with pytest.raises(UsageError, match="increase `version`"):
        known.decide("left", camera(c=8.001), changed, since=day(7))
    newer = changed.model_copy(update={"version": 2})
    assert known.decide("left", camera(c=8.001), newer, since=day(7)).judgement.rules["version"] == 2


def test_a_configuration_has_parts_of_its_own(archive: Archive) -> None:
    known, _ = started(archive)
    known.define("right", {"camera": "DMK 34", "lens": "8 mm f/8"})
    with pytest.raises(UsageError, match="exists with other parts"):
        known.define("left", {"camera": "other"})
    with pytest.raises(UsageError, match="has the parts of left"):
        known.define("again", {"camera": "DMK 33", "lens": "8 mm f/8"})
    with pytest.raises(UsageError, match="no time zone"):
        known.applied("left", datetime(2026, 3, 2))


def test_a_key_names_its_calibration_whatever_others_are_called(archive: Archive) -> None:
    known, first = started(archive)
    second = known.decide("left", camera(c=8.001), RULES, since=day(7))
    with pytest.raises(UsageError, match="form of a key"):
        known.rename("left", first, second.key)
    # As earlier versions allowed it.
    archive.journal("calibrations/left").add("name", {"key": first, "name": second.key, "by": "Ada"})
    assert known.decision("left", second.key).key == second.key
    known.rename("left", first, second.key[:4])
    with pytest.raises(UsageError, match="names 2 decisions"):
        known.decision("left", second.key[:4])


def test_a_session_is_the_origin_only_of_calibrations_among_its_results(archive: Archive) -> None:
    known, first = started(archive)
    session = archive.begin("monday", "frames", {"count": 1})
    new = camera(c=8.001)
    with pytest.raises(UsageError, match="does not have this calibration"):
        known.decide("left", new, RULES, since=day(7), session="monday")
    session.keep("calibration.json", new.to_json())
    with pytest.raises(UsageError, match="does not have this calibration"):
        known.decide("left", camera(c=8.002), RULES, since=day(7), session="monday")
    made = known.decide("left", new, RULES, since=day(7), session="monday", comment="session tuesday")
    assert (made.session, made.comment) == ("monday", "session tuesday")
    assert known.decision("left", first).session is None


def test_a_creeping_drift_is_announced_and_held_back_and_counts_from_the_reference(archive: Archive) -> None:
    known, _ = started(archive)
    rng, made = np.random.default_rng(5), []
    for k in range(1, 13):  # 0.06 px a week, of which 0.4 px are allowed
        values = {key: FIRST[key] + SIGMA[key] * rng.normal() for key in SIGMA}
        values["c"] += 0.0012 * k
        made.append(known.decide("left", camera(**values), RULES, since=day(7 * k)))
    px = [0.06 * k for k in range(1, 13)]
    held = [d.outcome == "needs review" for d in made]
    assert not any(h for h, size in zip(held, px, strict=True) if size < 0.38)
    assert all(h for h, size in zip(held, px, strict=True) if size > 0.44)
    trends = [[f.text for f in d.judgement.findings if f.rule == "trend"] for d in made]
    assert [bool(each) for each in trends[:6]] == [False, False, False, True, True, True]
    # Six weeks and five days after the first one.
    assert "reaches the limit of 0.4 px about 2026-04-1" in trends[4][0]
    low, high = re.findall(r"\((\S+) to (\S+)\)", trends[3][0])[0]
    assert low < "2026-04-17" < high < "2026-05-31"
    last = made[5].key
    with pytest.raises(UsageError, match="was not accepted"):
        known.set_reference("left", made[-1].key, comment="new")
    known.set_reference("left", last, by="Ada", comment="the lens was fixed")
    assert known.reference("left") == last
    values = {key: FIRST[key] for key in SIGMA} | {"c": 8.0 + 0.0012 * 6}
    assert known.decide("left", camera(**values, name="again"), RULES, since=day(91)).outcome != "rejected"


@pytest.mark.slow
def test_a_season_is_told_beside_a_trend_until_it_has_turned(archive: Archive) -> None:
    known, _ = started(archive)
    rng, said = np.random.default_rng(5), list[str]()
    for k in range(1, 27):  # a yearly swing of 0.3 px, of which 0.4 px are allowed
        values = {key: FIRST[key] + 4 * SIGMA[key] * rng.normal() for key in SIGMA}
        values["c"] += 0.006 * np.sin(2 * np.pi * 7 * k / 365.25)
        made = known.decide("left", camera(scale=4.0, **values), RULES, since=day(7 * k))
        assert made.outcome in ("accepted", "accepted with warning")
        said.append("; ".join(f.text for f in made.judgement.findings if f.rule == "trend"))
    assert any(said[:13])
    assert all("follows the seasons" in each and "; or creeps by" in each for each in said if each)
    assert not any(said[13:])


@pytest.mark.slow
def test_a_stable_camera_is_accepted(archive: Archive) -> None:
    known, _ = started(archive)
    rng, found = np.random.default_rng(6), []
    for k in range(1, 21):
        values = {key: FIRST[key] + 8 * SIGMA[key] * rng.normal() for key in SIGMA}
        found.append(known.decide("left", camera(scale=8.0, **values), RULES, since=day(7 * k)).outcome)
    assert found.count("accepted") >= 19, found


def test_the_uncertainty_of_no_change_is_that_of_the_comparison() -> None:
    # The same photographs again: a difference of exactly nothing.
    found = judge(camera(name="again"), camera(), RULES).findings
    text = next(each.text for each in found if each.rule == "image")
    low, high = (float(each) for each in re.findall(r"a change of (\S+) ± (\S+) px", text)[0])
    assert low == 0.0
    assert 0.005 < high < 0.05  # one of a run is 0.01 px
    exact = RunHistory(np.array([0.0, 7.0]), np.zeros((2, 1)), np.ones((2, 1, 1)), np.full((1, 2, 1), 0.01))
    size, sigma = explain_runs(exact, 0.4, 0).size(step=True)
    assert size == 0.0
    assert 0.005 < sigma < 0.05


@pytest.mark.slow
def test_a_drift_of_one_parameter_is_signalled_and_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    with Archive.open(tmp_path / "archive", create=True) as archive:
        known, _ = started(archive)
        for k in range(1, 46):
            c = 8.0 + 1e-4 * rng.normal() + (8e-4 if k > 35 else 0.0)
            values = {key: FIRST[key] + SIGMA[key] * rng.normal() for key in ("x0", "y0", "K1")}
            known.decide("left", camera(c=c, **values), RULES, since=day(7 * k))
        found = known.drift("left")
        run, series = next(iter(np.argwhere(found.charts.alarm).tolist()))
        assert found.names[series] in ("c", "norm of the field")
        assert 36 <= run <= 40
        known.event("left", "repaired", at=day(7 * 40.5))
        assert len(known.drift("left").keys) == 5


def test_the_command_line_decides_and_applies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    camera().write("first.json")
    camera(c=8.001).write("second.json")
    camera(c=8.2).write("third.json")
    RULES.write("rules.json")
    Path("points.csv").write_text("id,x,y,sx,sy\na,600,400,0.1,0.1\n")
    assert run(["calibrations", "define", "left", "-p", "camera=DMK 33", "-p", "lens=8 mm"]) == 0
    decide = ["calibrations", "decide", "left", "--rules", "rules.json", "--since"]
    assert run([*decide, "2026-03-02T08:00Z", "first.json"]) == 1
    capsys.readouterr()
    assert run(["calibrations", "history", "left", "--json"]) == 0
    key = json.loads(capsys.readouterr().out)["decisions"][0]["key"]
    assert run(["calibrations", "review", "left", key, "accepted", "-m", "first"]) == 0
    assert run([*decide, "2026-03-09T08:00Z", "second.json"]) == 0
    assert run([*decide, "2026-03-16T08:00Z", "third.json"]) == 1
    said = capsys.readouterr().out
    assert "rejected" in said
    assert "largest difference" in said
    apply = ["apply", "left", "points.csv", "--archive", "archive", "--directions", "--json", "--at"]
    assert run([*apply, "2026-03-05T08:00+01:00"]) == 0
    by_archive = capsys.readouterr().out
    assert run(["apply", "first.json", "points.csv", "--directions", "--json"]) == 0
    assert capsys.readouterr().out == by_archive
    assert run([*apply, "2026-03-10T00:00Z"]) == 0
    assert capsys.readouterr().out != by_archive
    for arguments, part in (
        ([*apply, "2026-03-01T00:00Z"], "left: has no calibration in force at 2026-03-01 00:00Z"),
        ([*apply, "2026-03-10"], "has no time zone"),
        (["apply", "left", "points.csv", "--archive", "archive"], "--at: is needed with --archive"),
        (["apply", "first.json", "points.csv", "--at", "2026-03-10T00:00Z"], "--at: needs --archive"),
        (["calibrations", "show", "middle"], "middle: is not a configuration of this archive; use left"),
        (["calibrations", "review", "left", key[:4], "fine", "-m", "x"], "is no outcome of a review"),
    ):
        assert run(arguments) == 2
        assert part in capsys.readouterr().err
    assert run(["calibrations", "drift", "left", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"] == 2
    assert run(["calibrations", "event", "left", "camera dropped"]) == 0
    assert run(["calibrations", "show"]) == 0
    assert "left: no calibration in force" in capsys.readouterr().out
