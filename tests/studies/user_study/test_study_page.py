"""The pairs of a study, its page and its key."""

import base64
import hashlib
import json
import re

import pytest
from support.compare_folders import METHODS, write_compare_folder, write_picture

from climatenerf.core.errors import UserError
from climatenerf.studies.user_study.compare_folder import read_compare_folder
from climatenerf.studies.user_study.design import plan_study, share_turns
from climatenerf.studies.user_study.page import page, write_study
from climatenerf.studies.user_study.votes import read_key


def folders(tmp_path, **settings):
    return [
        read_compare_folder(write_compare_folder(tmp_path / scene, scene, **settings))
        for scene in ("ditch", "road")
    ]


def written(study, out, **settings):
    return write_study(study, out, lambda done, total: None, **settings)


def page_data(out):
    found = re.search(r'id="data">(.*?)</script>', (out / "index.html").read_text(), re.DOTALL)
    return json.loads(found[1])


def test_ours_is_paired_with_every_other_method(tmp_path):
    study = plan_study(folders(tmp_path, effects=("flood", "snow"), views=2, movies=1))
    assert len(study.pairs) == 2 * 2 * 3 * 4 and study.alone == 0
    for pair in study.pairs:
        assert pair.first.method == "climatenerf" != pair.second.method
        assert (pair.first.scene, pair.first.effect, pair.first.kind, pair.first.view) == (
            pair.second.scene, pair.second.effect, pair.second.kind, pair.second.view
        )  # fmt: skip
    assert {pair.comparison for pair in study.pairs} == {
        (effect, kind, method)
        for effect in ("flood", "snow")
        for kind in ("picture", "movie")
        for method in METHODS[1:]
    }
    assert study.votes == 48, "no more than there are"


def test_what_has_no_counterpart_is_left_out_and_counted(tmp_path):
    folder = write_compare_folder(tmp_path / "ditch", effects=("flood",), views=2)
    table = json.loads((folder / "compare.json").read_text())
    table["items"] = [
        item
        for item in table["items"]
        if not (item["method"] == METHODS[0] and item["view"] == "1")
    ]
    (folder / "compare.json").write_text(json.dumps(table))
    study = plan_study([read_compare_folder(folder)])
    assert len(study.pairs) == 4 and study.alone == 4


def test_methods_can_be_left_out(tmp_path):
    both = folders(tmp_path, effects=("flood",), views=1)
    study = plan_study(both, without=METHODS[2:4])
    assert {pair.second.method for pair in study.pairs} == {METHODS[1], METHODS[4]}
    assert study.alone == 0 and len(study.pairs) == 4
    written(study, tmp_path / "out")
    text = (tmp_path / "out" / "key.json").read_text()
    assert METHODS[4] in text and METHODS[2] not in text
    for name in ("painter", METHODS[0]):
        with pytest.raises(UserError, match=f"no method '{name}' to leave out; use one of ARF-9"):
            plan_study(both, without=[name])
    with pytest.raises(UserError, match="nothing can be paired"):
        plan_study(both, without=METHODS[1:])


def test_comparisons_take_turns():
    assert share_turns([4, 4, 4], 12) == [4, 4, 4]
    assert share_turns([4, 4, 4], 6) == [2, 2, 2]
    assert share_turns([1, 5, 5], 7) == [1, 3, 3]
    assert share_turns([2, 2], 3) == [1.5, 1.5]
    assert share_turns([9, 1], 72) == [9, 1]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.update(scene="ditch"), "2 folders show the scene ditch"),
        (lambda t: t.update(scene="by ClimateNeRF"), "the method climatenerf in the scene"),
        (lambda t: t["items"][0].update(effect="global mk"), "the method global MK in the effect"),
    ],
)
def test_what_participants_could_tell_methods_by_is_refused(tmp_path, change, expected):
    folders(tmp_path, effects=("flood",), views=1)
    file = tmp_path / "road" / "compare.json"
    table = json.loads(file.read_text())
    change(table)
    file.write_text(json.dumps(table))
    both = [read_compare_folder(tmp_path / scene) for scene in ("ditch", "road")]
    with pytest.raises(UserError, match=expected):
        plan_study(both)


def test_licence_lines_that_name_a_method_are_hidden_and_parts_of_words_are_no_names(tmp_path):
    folders(tmp_path, effects=("flood",), views=1)
    file = tmp_path / "road" / "compare.json"
    table = json.loads(file.read_text())
    table |= {"licence": "Apache-2.0, part of ClimateNeRF", "scene": "ARF-99"}
    file.write_text(json.dumps(table))
    both = [read_compare_folder(tmp_path / scene) for scene in ("ditch", "road")]
    assert plan_study(both).sources() == (["ditch: photos of ditch, CC0"], ["ARF-99"])


def test_studies_that_cannot_be(tmp_path):
    one = folders(tmp_path, methods=METHODS[:2], effects=("flood",), views=1)[:1]
    for votes in (0, -1, 1001):
        with pytest.raises(UserError, match="--votes must lie between 1 and 1000"):
            plan_study(one, votes=votes)
    with pytest.raises(UserError, match="no comparison is given"):
        plan_study([])
    alone = write_compare_folder(tmp_path / "alone", "alone", METHODS[:1], ("flood",))
    with pytest.raises(UserError, match="nothing can be paired"):
        plan_study([read_compare_folder(alone)])
    other = write_compare_folder(tmp_path / "x", "x", ("another", "flat painter"), ("flood",))
    with pytest.raises(UserError, match=r"several names \(another, climatenerf\)"):
        plan_study([*one, read_compare_folder(other)])


def test_the_page_names_no_method_and_holds_its_media(tmp_path):
    study = plan_study(folders(tmp_path, effects=("flood",), views=1))
    name = written(study, tmp_path / "out").id
    html = (tmp_path / "out" / "index.html").read_text()
    assert not [method for method in METHODS if method.casefold() in html.casefold()]
    assert "http:" not in html and "https:" not in html and "{{" not in html
    data, key = page_data(tmp_path / "out"), json.loads((tmp_path / "out" / "key.json").read_text())
    assert data["id"] == key["study"] == name and len(data["pairs"]) == 8
    for medium, held in data["media"].items():
        digest = hashlib.sha256(base64.b64decode(held["data"])).hexdigest()
        assert key["media"][medium]["sha256"] == digest and held["file"] is None
    for shown, listed in zip(data["pairs"], key["pairs"], strict=False):
        assert shown["media"] == [listed["first"], listed["second"]]
        methods = [key["media"][medium]["method"] for medium in shown["media"]]
        assert methods == ["climatenerf", listed["other"]]
        assert shown.keys() == {"id", "kind", "effect", "scene", "group", "media"}
    assert len({pair["group"] for pair in data["pairs"]}) == 4
    assert set(read_key(tmp_path / "out" / "key.json").pairs) == {
        pair["id"] for pair in data["pairs"] + data["catches"]
    }
    assert data["sources"] == [f"{scene}: photos of {scene}, CC0" for scene in ("ditch", "road")]


def test_catch_pairs_are_clean_against_noisy(tmp_path):
    study = plan_study(folders(tmp_path, effects=("flood",), views=1))
    written(study, tmp_path / "out")
    key = read_key(tmp_path / "out" / "key.json")
    catches = [pair for pair in key.pairs.values() if pair.catch]
    media = json.loads((tmp_path / "out" / "key.json").read_text())["media"]
    assert len(catches) == 2 and all(pair.other is None for pair in catches)
    assert [media[pair.first]["method"] for pair in catches] == ["climatenerf"] * 2
    assert [media[pair.second]["method"] for pair in catches] == [None] * 2
    assert len({media[pair.first]["scene"] for pair in catches}) == 2, "of two pictures"


def test_the_same_study_is_written_alike_and_no_other_over_it(tmp_path):
    study = plan_study(folders(tmp_path, effects=("flood",), views=1))
    first = written(study, tmp_path / "out")
    before = [(tmp_path / "out" / name).read_bytes() for name in ("index.html", "key.json")]
    (tmp_path / "out" / "index.html").unlink()  # as if it had been stopped before the page
    assert written(study, tmp_path / "out") == first
    assert before == [(tmp_path / "out" / name).read_bytes() for name in ("index.html", "key.json")]
    others = [
        plan_study(study.folders, seed=1),
        plan_study(study.folders, votes=3),
        plan_study(study.folders[:1]),
    ]
    write_picture(study.pairs[0].second.path, 99)  # it was rendered again
    for other in (*others, study):
        with pytest.raises(UserError, match=f"holds another study \\({first.id}\\)"):
            written(other, tmp_path / "out")
    assert before == [(tmp_path / "out" / name).read_bytes() for name in ("index.html", "key.json")]


@pytest.mark.parametrize("name", ["index.html", "key.json", "media"])
def test_other_files_of_these_names_are_kept(tmp_path, name):
    study = plan_study(folders(tmp_path, effects=("flood",), views=1))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text('{"mine": 1}')
    with pytest.raises(UserError, match="belongs to no study"):
        written(study, tmp_path / "out")
    assert (tmp_path / "out" / name).read_text() == '{"mine": 1}'


def test_a_damaged_picture_leaves_nothing_behind(tmp_path):
    study = plan_study(folders(tmp_path, effects=("flood",), views=1))
    study.pairs[3].second.path.write_text("no picture")
    with pytest.raises(UserError, match="cannot be decoded"):
        written(study, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_large_media_lie_beside_the_page(tmp_path):
    study = plan_study(folders(tmp_path, effects=("flood",), views=1))
    total = sum(item.path.stat().st_size for item in study.media().values())
    assert written(study, tmp_path / "in", max_inline=total).inline
    found = written(study, tmp_path / "beside", max_inline=total - 1)
    assert not found.inline and found.id == page_data(tmp_path / "in")["id"]
    data = page_data(tmp_path / "beside")
    catch = {medium for pair in data["catches"] for medium in pair["media"]}
    for medium, held in data["media"].items():
        if held["data"] is None:
            file = tmp_path / "beside" / held["file"]
            inline = page_data(tmp_path / "in")["media"][medium]["data"]
            assert file.read_bytes() == base64.b64decode(inline) and medium in file.name
        else:
            assert medium in catch
    assert sum(held["data"] is None for held in data["media"].values()) == len(study.media())


def test_sizes_that_differ_are_counted(tmp_path):
    study = plan_study(folders(tmp_path, effects=("flood",), views=1))
    write_picture(study.pairs[2].second.path, 5, (40, 18))
    assert written(study, tmp_path / "out").unequal == 1


def test_texts_of_the_page_end_no_script(tmp_path):
    text = "</script><script>alert(1)</script>{{script}}"
    html = page({"id": text}).decode()
    assert "alert(1)" in html and "</script><script>alert" not in html
    assert html.count("</script>") == 2 and json.loads(
        re.search(r'id="data">(.*?)</script>', html)[1]
    ) == {"id": text}


def test_the_policy_allows_the_page_its_own_script_and_style_alone():
    html = page({}).decode()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', html)[1]
    for tag in ("style", "script"):
        text = re.search(rf"<{tag}>(.*?)</{tag}>", html, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy
