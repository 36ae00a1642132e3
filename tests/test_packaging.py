import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_wheel_holds_every_module_and_the_model_file(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    roots = [ROOT, ROOT / "envs", ROOT / "policies"]
    expected = {
        str(path.relative_to(root))
        for root in roots
        for pattern in ("lerobot_*/**/*.py", "lerobot_*/**/py.typed", "lerobot_*/**/*.xml")
        for path in root.glob(pattern)
    }
    assert packed == expected
    assert "lerobot_env_bomb/scene.xml" in packed
