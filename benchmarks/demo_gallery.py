"""Makes the figures of docs/gallery.md that show the demo: its run, its diagnosis, fields inside the skin.

    python benchmarks/demo_gallery.py

The program runs `bayeskin run runs/demo.toml` and `bayeskin diagnose runs/demo.toml`, which skip finished
stages, and `bayeskin simulate --figures`. It copies their figures to docs/figures/demo-*.png, reduced to 256
colours.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs" / "figures"
OF_THE_RUN = (
    "recording/recording", "train/prior_predictive", "train/validation", "map/map_check", "sample/fit",
    "sample/posterior", "sample/profiles", "sample/traces", "sample/residuals", "sobol/sobol_prior_gp",
    "diagnose/before_after",
)  # fmt: skip


def called(*arguments: str) -> None:
    """Runs a command of bayeskin in the checkout; ends the program where the input is wrong."""
    command = [sys.executable, "-c", "from bayeskin.cli import main; main()", *arguments]
    if subprocess.run(command, cwd=ROOT, check=False).returncode > 1:
        raise SystemExit(f"bayeskin {' '.join(arguments)} failed")


def smaller(path: Path, target: Path) -> None:
    """Saves a PNG in 256 colours and keeps its text entries, so that the repository stays small."""
    with Image.open(path) as image:
        texts = PngInfo()
        for key, text in image.info.items():
            if isinstance(key, str) and isinstance(text, str):
                texts.add_text(key, text)
        colours = image.convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE)
        colours.save(target, optimize=True, pnginfo=texts, dpi=image.info["dpi"])


def main() -> None:
    called("run", "runs/demo.toml")
    called("diagnose", "runs/demo.toml")
    with tempfile.TemporaryDirectory() as folder:
        called("simulate", "-o", f"{folder}/force.csv", "--figures", folder)
        figures = [Path(folder) / "fields.png"]
        figures += [ROOT / "runs" / "demo" / f"{name}.png" for name in OF_THE_RUN]
        for path in figures:
            target = FIGURES / f"demo-{path.stem.replace('_', '-')}.png"
            smaller(path, target)
            print(target.relative_to(ROOT))


if __name__ == "__main__":
    main()
