"""The index of published policies names each of them as it is on disk."""

import json
import shutil

from docs.index_policies import DATA, INDEX, folder_digest, index_rows, index_text


def test_the_published_index_is_what_the_command_writes():
    assert INDEX.read_text() == index_text(index_rows())
    rows = json.loads(INDEX.read_text())
    assert len(rows) == len(list(DATA.glob("*_policies/*/policy.json"))) > 100
    assert len({(row["name"], row["seed"]) for row in rows}) == len(rows)
    assert all((DATA.parent / row["path"]).is_dir() for row in rows)


def test_a_changed_byte_or_name_changes_the_digest(tmp_path):
    first = DATA.parent / json.loads(INDEX.read_text())[0]["path"]
    copy = tmp_path / "copy"
    shutil.copytree(first, copy)
    assert folder_digest(copy) == folder_digest(first)
    (copy / "policy.json").rename(copy / "renamed.json")
    assert folder_digest(copy) != folder_digest(first)
    (copy / "renamed.json").rename(copy / "policy.json")
    (copy / "policy.json").write_text((copy / "policy.json").read_text() + " ")
    assert folder_digest(copy) != folder_digest(first)
