"""The page of a study in Chromium: a participant's way through it, and its plan."""

import csv
import io
import json
from collections import Counter

import pytest
from support.browser import chromium, opened_page, wait_until
from support.command_line import run_cli
from support.compare_folders import METHODS, write_compare_folder

from climatenerf.studies.user_study.compare_folder import read_compare_folder
from climatenerf.studies.user_study.design import plan_study
from climatenerf.studies.user_study.page import write_study
from climatenerf.studies.user_study.scores import score
from climatenerf.studies.user_study.votes import read_key, read_votes

SCENES = ("ditch", "stone, sign", "road")
READY = "#choose-left[aria-disabled=false]"
DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Folder of a study of 72 pairs: 3 scenes, 3 effects, 4 other methods, 2 views."""
    root = tmp_path_factory.mktemp("study")
    folders = [write_compare_folder(root / scene, scene) for scene in SCENES]
    assert run_cli("study", "make", *folders, "-o", root / "out") == 0
    return root / "out"


def opened(browser, folder, number="", viewport=DESKTOP, context=None):
    """Open the page; what goes wrong in it, and what it requests, is collected."""
    context = context or browser.new_context(viewport=viewport, accept_downloads=True)
    address = (folder / "index.html").as_uri() + (f"#{number}" if number else "")
    return opened_page(context, address)


def start(page):
    page.check("#consent")
    page.click("#enter button")
    page.wait_for_selector(READY)


def shown(page):
    """Ids of the trial's left and right medium."""
    return page.evaluate("sidesOf(trials[votes.length])")


def vote(page, key):
    """Vote as soon as a pair is shown, and wait until it is counted."""
    wait_until(page, "ready")
    # Pretend that the pair has been looked at for long enough.
    before = page.evaluate("readyAt -= NOT_BEFORE, votes.length")
    page.keyboard.press(key)
    wait_until(page, f"votes.length === {before + 1}")


def plan(page, number):
    """The plan of a participant: (pair, whether ours is left, repeat, catch)."""
    return page.evaluate(
        "n => plan(study, n).map(t => [t.pair.id, !t.swapped, t.repeat, t.catch])", number
    )


def exported(page):
    with page.expect_download() as download:
        page.click("#save")
    return download.value.suggested_filename, download.value.path().read_bytes().decode()


def test_a_participant_judges_72_pairs_with_a_reload(browser, study, tmp_path):
    """The participant prefers ours but in snow, and always sees the noise."""
    key = read_key(study / "key.json")
    page = opened(browser, study, 7)
    start(page)
    for number in range(77):
        if number == 40:
            page.reload()
            page.wait_for_selector(READY)
            assert page.inner_text("#position") == "41 of 77"
        left, _ = shown(page)
        pair = key.pairs[page.evaluate("trials[votes.length].pair.id")]
        first = pair.catch or pair.effect != "snow"
        question = f"{pair.effect.capitalize()}: which one looks more realistic?"
        assert page.inner_text("#question") == question
        assert not [name for name in METHODS if name.casefold() in page.content().casefold()]
        vote(page, "1" if (left == pair.first) == first else "2")
    page.wait_for_selector("#end:not([hidden])")
    assert "judged all pairs" in page.inner_text("#end-text")
    name, text = exported(page)
    assert name == f"votes-{key.study}-7.csv" and page.problems == []
    assert {url.partition(":")[0] for url in page.requests} == {"file", "blob"}
    own = (study / "index.html").as_uri()
    assert {url.partition("#")[0] for url in page.requests if url[0] == "f"} == {own}

    rows = list(csv.DictReader(io.StringIO(text)))
    assert [int(row["order"]) for row in rows] == list(range(1, 78))
    assert all(0 <= int(row["ms"]) < 60_000 for row in rows)
    judged = [row for row in rows if row["repeat"] == row["catch"] == "0"]
    assert Counter(row["pair"] for row in judged) == dict.fromkeys(
        (pair.id for pair in key.pairs.values() if not pair.catch), 1
    )
    (tmp_path / "votes.csv").write_text(text, newline="")
    scores = score(read_votes([tmp_path / "votes.csv"], key), key, resamples=20)
    assert scores.excluded == scores.unchecked == ()
    assert all(each.ours.votes == 6 for each in scores.comparisons)
    assert {each.ours.share for each in scores.comparisons if each.effect == "snow"} == {0}
    assert {each.ours.share for each in scores.comparisons if each.effect != "snow"} == {1}
    assert (scores.repeat_agreement.votes, scores.repeat_agreement.share) == (3, 1)
    out = tmp_path / "report"
    assert run_cli("study", "score", tmp_path / "votes.csv", "--key", study / "key.json",
                   "-o", out) == 0  # fmt: skip
    assert json.loads((out / "scores.json").read_text())["participants"] == 1
    page.reload()
    assert page.inner_text("#end-title") == "Thank you", "the votes stay until they are handed over"
    page.context.close()


def test_plans_are_balanced_and_differ(browser, study):
    page = opened(browser, study)
    plans = {number: plan(page, number) for number in range(1, 41)}
    assert plans == {number: plan(page, number) for number in plans}, "a reload finds the same"
    orders = [
        tuple(pair for pair, _, again, catch in each if not again and not catch)
        for each in plans.values()
    ]
    assert len(set(orders)) == 40
    groups = page.evaluate("Object.fromEntries(study.pairs.map(p => [p.id, p.group]))")
    left_of = Counter()
    for number, each in plans.items():
        main = [trial for trial in each if not trial[2] and not trial[3]]
        assert len(main) == 72 and len({pair for pair, *_ in main}) == 72
        assert sum(left for _, left, *_ in main) == 36
        by_group = Counter()
        for pair, left, *_ in main:
            by_group[groups[pair]] += 1 if left else -1
            left_of[pair] += 1 if left else -1
        assert max(map(abs, by_group.values())) <= 1
        assert max(map(abs, left_of.values())) <= 1, (
            f"pairs are balanced over {number} participants"
        )
    first = [each[0][0] for each in plans.values()]
    assert max(Counter(first).values()) <= 4, "no pair is always first"
    early = Counter(pair for each in plans.values() for pair, *_ in each[:38])
    assert all(7 <= early[pair] <= 34 for pair in left_of), "places are even"
    page.context.close()


def test_repeats_and_catch_pairs_are_hidden_among_the_others(browser, study):
    page = opened(browser, study)
    halves = Counter()
    for number in range(1, 41):
        trials = plan(page, number)
        main = {pair: (place, left) for place, (pair, left, again, catch) in enumerate(trials)
                if not again and not catch}  # fmt: skip
        repeats = [(place, *trial) for place, trial in enumerate(trials) if trial[2]]
        catches = [place for place, trial in enumerate(trials) if trial[3]]
        assert len(trials) == 77 and len(repeats) == 3 and len(catches) == 2
        for place, pair, left, _, catch in repeats:
            assert not catch and left != main[pair][1], "sides are exchanged"
            assert place - main[pair][0] >= 15, "the pair is forgotten"
        assert 0 < catches[0] < catches[1] < 77
        halves.update("first" if place < 39 else "second" for place in catches)
        assert not trials[0][3]
    assert halves["first"] == pytest.approx(40, abs=4)
    page.context.close()


def test_fewer_votes_than_pairs_are_shared_out_evenly(browser, tmp_path):
    folder = read_compare_folder(write_compare_folder(tmp_path / "ditch", views=5))
    write_study(plan_study([folder], votes=24), tmp_path / "out", lambda done, total: None)
    page = opened(browser, tmp_path / "out")
    groups = page.evaluate("Object.fromEntries(study.pairs.map(p => [p.id, p.group]))")
    chosen = Counter()
    for number in range(1, 31):
        main = [trial for trial in plan(page, number) if not trial[2] and not trial[3]]
        assert Counter(groups[pair] for pair, *_ in main) == dict.fromkeys(groups.values(), 2)
        assert sum(left for _, left, *_ in main) == 12
        chosen.update(pair for pair, *_ in main)
        if number % 2 == 0:
            partner = {
                pair: left for pair, left, again, catch in plan(page, number - 1) if not again
            }
            assert all(partner[pair] != left for pair, left, *_ in main), "sides mirrored"
    assert len(chosen) == 60 and max(chosen.values()) < 24, "every pair has its turn"
    page.context.close()


def test_one_pair_makes_a_study(browser, tmp_path):
    folder = write_compare_folder(tmp_path / "ditch", "ditch", METHODS[:2], ("flood",), 1)
    write_study(plan_study([read_compare_folder(folder)]), tmp_path / "out", lambda *_: None)
    page = opened(browser, tmp_path / "out", 1)
    assert [trial[2:] for trial in plan(page, 1)].count([False, True]) == 2
    assert len(plan(page, 1)) == 3 and "3 pairs of pictures." in page.inner_text("#welcome")
    page.context.close()


def test_nothing_starts_without_consent(browser, study):
    page = opened(browser, study, 3)
    assert "voluntarily" in page.inner_text(".consent")
    page.click("#enter button")
    assert page.is_visible("#welcome") and page.is_hidden("#trial")
    page.fill("#participant", "0")
    page.check("#consent")
    page.click("#enter button")
    assert page.is_visible("#welcome"), "a number begins at 1"
    page.fill("#participant", "")
    start(page)
    assert page.evaluate("participant") >= 1e8, "a random number without one"
    page.context.close()


def test_keys_vote_once_and_only_when_pictures_are_shown(browser, study):
    page = opened(browser, study, 5)
    page.keyboard.press("1")
    assert page.evaluate("votes.length") == 0, "not on the first page"
    page.focus("#consent")
    page.keyboard.press("Space")
    page.keyboard.press("Enter")
    page.wait_for_selector(READY)
    page.evaluate("readyAt = performance.now()")
    page.keyboard.press("1")
    assert page.evaluate("votes.length") == 0, "not in the first fifth of a second"
    vote(page, "2")
    page.wait_for_selector(READY)
    wait_until(page, "performance.now() - readyAt >= NOT_BEFORE")
    page.keyboard.press("Control+1")
    for key in ("3", "a", " "):
        page.keyboard.press(key)
    page.evaluate("document.dispatchEvent(new KeyboardEvent('keydown', {key: '1', repeat: true}))")
    assert page.evaluate("votes.map(v => v.choice)") == ["right"]
    page.focus("#choose-left")
    page.keyboard.press("Enter")
    wait_until(page, "votes.length === 2")
    assert page.evaluate("votes.map(v => v.choice)") == ["right", "left"]
    page.context.close()


def test_a_phone_shows_pictures_one_below_the_other(browser, study):
    context = browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True)
    page = opened(browser, study, 9, context=context)
    start(page)
    upper, lower = (page.locator(f"#{side} img").bounding_box() for side in ("left", "right"))
    assert upper["width"] > 350 and lower["y"] >= upper["y"] + upper["height"]
    for side in ("left", "right"):
        box = page.locator(f"#choose-{side}").bounding_box()
        assert box["height"] >= 44 and box["y"] + box["height"] <= PHONE["height"]
    assert page.inner_text("#choose-left").split() == ["1", "upper"]
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    wait_until(page, "performance.now() - readyAt >= NOT_BEFORE")
    page.tap("#choose-right")
    wait_until(page, "votes.length === 1")
    assert page.evaluate("votes[0].choice") == "right"
    context.close()


def test_stopping_and_several_participants_on_one_device(browser, study):
    page = opened(browser, study, 5)
    start(page)
    vote(page, "1")
    page.click("#stop")
    assert "1 of 77" in page.inner_text("#end-text")
    assert len(exported(page)[1].splitlines()) == 2
    page.click("#continue")
    page.wait_for_selector(READY)
    assert page.inner_text("#position") == "2 of 77"
    other = opened(browser, study, 6, context=page.context)
    assert other.is_visible("#welcome") and other.input_value("#participant") == "6"
    start(other)
    vote(other, "2")
    vote(other, "2")
    back = opened(browser, study, 5, context=page.context)
    start(back)
    assert back.inner_text("#position") == "2 of 77", "each continues with the own votes"
    page.context.close()


def test_votes_that_storage_has_damaged_are_dropped(browser, study):
    page = opened(browser, study, 5)
    for value in (
        "no json",
        "5",
        '[{"choice": "both", "ms": 1}]',
        '[{"choice": "left"}]',
        "[null]",
    ):
        page.evaluate("value => store('votes/5', value)", value)
        assert page.evaluate("votesOf(5)") is None
    page.evaluate("store('votes/5', JSON.stringify([{choice: 'left', ms: 5}]))")
    assert page.evaluate("votesOf(5)") == [{"choice": "left", "ms": 5}]
    page.context.close()


def test_a_browser_without_storage_says_so(browser, study):
    context = browser.new_context(viewport=DESKTOP)
    context.add_init_script(
        "Object.defineProperty(window, 'localStorage', {get() { throw new Error('blocked'); }})"
    )
    page = opened(browser, study, 5, context=context)
    assert "not let the page save" in page.inner_text("#no-storage")
    start(page)
    vote(page, "1")
    assert page.evaluate("votes.length") == 1 and page.problems == []
    context.close()


def test_movies_play_once_before_a_vote(browser, tmp_path):
    folder = write_compare_folder(
        tmp_path / "ditch", "ditch", METHODS[:2], ("flood",), views=0, movies=1
    )
    write_study(plan_study([read_compare_folder(folder)]), tmp_path / "out", lambda *_: None)
    page = opened(browser, tmp_path / "out", 1)
    assert "pairs of movies." in page.inner_text("#welcome")
    page.check("#consent")
    page.click("#enter button")
    wait_until(page, "trials[votes.length].pair.kind === 'movie' || ready")
    while page.evaluate("trials[votes.length].catch"):
        vote(page, "1")
    page.wait_for_selector("video")
    page.evaluate("for (const v of document.querySelectorAll('video')) v.playbackRate = 0.1")
    wait_until(page, "[...document.querySelectorAll('video')].every(v => v.currentTime > 0.01)")
    assert page.inner_text("#hint") == "Watch both to the end."
    count = page.evaluate("votes.length")
    page.evaluate("readyAt = 0")
    page.keyboard.press("1")
    page.click("#choose-right", force=True)
    assert page.evaluate("votes.length") == count, "no vote before the end"
    assert page.evaluate("[...document.querySelectorAll('video')].every(v => v.muted)")
    page.evaluate("document.querySelectorAll('video')[0].playbackRate = 4")
    wait_until(page, "document.querySelectorAll('video')[0].ended")
    assert page.get_attribute("#choose-left", "aria-disabled") == "true", "one of two is not enough"
    page.evaluate("document.querySelectorAll('video')[1].playbackRate = 4")
    page.wait_for_selector(READY)
    wait_until(page, "[...document.querySelectorAll('video')].every(v => !v.paused)")
    vote(page, "1")
    assert page.problems == []
    page.context.close()


def test_media_beside_the_page_are_shown(browser, tmp_path):
    folder = write_compare_folder(
        tmp_path / "ditch", "ditch", METHODS[:2], ("flood",), views=1, movies=1
    )
    study = plan_study([read_compare_folder(folder)])
    assert not write_study(study, tmp_path / "out", lambda *_: None, max_inline=0).inline
    page = opened(browser, tmp_path / "out", 1)
    page.check("#consent")
    page.click("#enter button")
    for _ in range(len(plan(page, 1))):
        vote(page, "1")
    assert page.is_visible("#end") and page.problems == []
    files = {url.rpartition("/")[2] for url in page.requests if "/media/" in url}
    assert (
        files == {path.name for path in (tmp_path / "out" / "media").iterdir()} and len(files) == 4
    )
    page.context.close()


def test_a_pair_that_cannot_be_shown_is_passed_over(browser, tmp_path):
    folder = write_compare_folder(tmp_path / "ditch", "ditch", METHODS[:2], ("flood",), 2)
    out = tmp_path / "out"
    write_study(plan_study([read_compare_folder(folder)]), out, lambda *_: None, max_inline=0)
    key = read_key(out / "key.json")
    lost = next(pair for pair in key.pairs.values() if not pair.catch)
    (out / "media" / f"{lost.second}.jpg").write_text("lost")
    page = opened(browser, out, 1)
    page.check("#consent")
    page.click("#enter button")
    for trial in plan(page, 1):
        if trial[0] == lost.id:
            page.wait_for_selector("#skip:not([hidden])")
            page.keyboard.press("1")
            page.click("#skip")
        else:
            vote(page, "1")
    (tmp_path / "votes.csv").write_text(exported(page)[1], newline="")
    scores = score(read_votes([tmp_path / "votes.csv"], key), key, resamples=20)
    assert scores.skipped >= 1 and scores.comparisons[0].ours.votes == 1
    page.context.close()
