"""Draws the README's result figure: `python docs/media/robustness.py`."""

from pathlib import Path

from lerobot_bomb.stats import wilson_interval

# condition, stones placed of episodes: trained on nominal scenes and under perturbations (docs/results.md)
RATES = [
    ("none", (196, 200), (198, 200)),
    ("table:3", (20, 50), (50, 50)),
    ("reflectance:3", (49, 50), (50, 50)),
    ("stones:3", (49, 50), (50, 50)),
    ("start:3", (6, 50), (42, 50)),
    ("photometric:3", (34, 50), (50, 50)),
    ("camera:3", (1, 50), (48, 50)),
    ("light:3", (0, 50), (50, 50)),
    ("language:3", (1, 50), (50, 50)),
    ("dynamics:3", (49, 50), (42, 50)),
    ("object:3", (34, 50), (49, 50)),
    ("all:3", (0, 50), (129, 200)),
]
SERIES = [("trained on nominal scenes", "#b8bec6"), ("trained under perturbations, shipped", "#2563a8")]
LEFT, TOP, SCALE, ROW, BAR = 130, 74, 5.2, 34, 11  # pixels; SCALE for each percent
WIDTH, HEIGHT = LEFT + 100 * SCALE + 40, TOP + ROW * len(RATES) + 12


def text(x: float, y: float, words: str, anchor: str = "start", size: int = 14, color: str = "#222") -> str:
    """Words at a place."""
    return (
        f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" font-size="{size}" fill="{color}">{words}</text>'
    )


def bar(x: float, y: float, successes: int, n: int, color: str) -> str:
    """A rate with its 95 % Wilson interval."""
    low, high = (x + 100 * SCALE * share for share in wilson_interval(successes, n))
    middle = y + BAR / 2
    width = 100 * SCALE * successes / n
    return (
        f'<rect x="{x:g}" y="{y:g}" width="{width:.1f}" height="{BAR}" fill="{color}"/>'
        f'<path d="M{low:.1f} {middle:g}H{high:.1f}" stroke="#222" stroke-width="1.5"/>'
    )


def figure() -> str:
    """The figure as SVG."""
    title = "Stones placed by vla0_smol, in percent, with 95 % intervals"
    parts = [f'<rect width="{WIDTH:g}" height="{HEIGHT:g}" fill="#fff"/>', text(LEFT, 20, title)]
    for i, (name, color) in enumerate(SERIES):
        x = LEFT + 210 * i
        parts += [
            f'<rect x="{x}" y="31" width="{BAR}" height="{BAR}" fill="{color}"/>',
            text(x + 18, 41, name, size=13),
        ]
    for percent in range(0, 101, 20):
        x = LEFT + SCALE * percent
        parts += [
            f'<path d="M{x:g} {TOP - 8}V{HEIGHT - 10:g}" stroke="#e3e6ea"/>',
            text(x, TOP - 12, str(percent), "middle", 12, "#666"),
        ]
    for i, (condition, *rates) in enumerate(RATES):
        y = TOP + ROW * i
        parts.append(text(LEFT - 10, y + BAR + 5, condition, "end"))
        parts += [
            bar(LEFT, y + (BAR + 1) * j, *rate, color)
            for j, (rate, (_, color)) in enumerate(zip(rates, SERIES, strict=True))
        ]
    size = f'width="{WIDTH:g}" height="{HEIGHT:g}" viewBox="0 0 {WIDTH:g} {HEIGHT:g}"'
    body = "\n".join(parts)
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">\n{body}\n</svg>\n'


if __name__ == "__main__":
    (Path(__file__).parent / "robustness.svg").write_text(figure())
