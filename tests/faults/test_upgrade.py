"""`packaging/upgrade.sh` on two machines: one is upgraded, one is rolled back."""

from pathlib import Path

from tests.faults.upgrade import NEW, OLD, machines, upgraded


def test_a_version_that_is_worse_is_rolled_back_and_ends_the_upgrades(tmp_path: Path) -> None:
    with machines(tmp_path, 3, bad=1) as fleet:
        good, bad = upgraded(fleet)
        assert (good.code, NEW in good.runs) == (0, True), good.says
        assert (bad.code, OLD in bad.runs) == (1, True), bad.says
        assert f"{NEW} is worse: 1 faults, 0 before" in bad.says
        assert "mixer is silent" in bad.says
        assert f"{OLD} is back" in bad.says
        assert OLD in fleet[2].health()
        assert fleet[0].upgrade().says == f"hall: {NEW} is the present version\n"
