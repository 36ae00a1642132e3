"""Do the heads of ``fdvla`` learn a distribution with two modes, and which mode a word means?

Points of the plane stand for actions: "left" and "right" name a mode, "any" means both. Heads, DualMod,
segment, loss and samplers are the policy's. One transformer layer takes the place of the vision-language
model, and a word reaches the heads through DualMod alone, as the control without it shows.
Leaves with exit code 1 if a bar is missed.

    python benchmarks/flow_toy.py --json flow_toy.json --plot docs/media/flow_toy.png

Shapes: `B` points of a batch, each a chunk of K = 1 action with D = 2 dims, `N` samples, `M` = 2 modes,
`H` width.
"""

import argparse
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from machine import add_json_argument, finish, make_parser, positive, print_rows, writable
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR

from lerobot_bomb.flow.losses import joint_loss
from lerobot_bomb.flow.path import draw_tau, path_point
from lerobot_bomb.flow.samplers import sample
from lerobot_policy_fdvla.configuration_fdvla import CONSISTENCY_LOSS_WEIGHT
from lerobot_policy_fdvla.networks_fdvla import ActionSegment, Head

MODES_MD = torch.tensor([[-1.0, 0.0], [1.0, 0.0]])
STD = 0.2
NEAR = 4 * STD  # what is farther from both modes is in neither
LEFT, RIGHT, BOTH = (1.0, 0.0), (0.0, 1.0), (0.5, 0.5)  # the data's share in each mode
WORDS = {"left": LEFT, "right": RIGHT, "any": BOTH}

WIDTH = 64
BATCH_SIZE = 256
LEARNING_RATE = 2e-3
MIN_SAMPLES = 100  # of a word: a cloud with none has no mean
SAMPLING_STEPS = 100  # few steps make the spread too small, whatever the heads have learned

# bars: least and largest share of the samples near a mode, by the data's
SHARE_BARS = {1.0: (0.99, 1.0), 0.5: (0.4, 0.6), 0.0: (0.0, 0.01)}
MEAN_BAR, STD_BAR = 0.1, 0.15  # largest errors of a mode

PLOT_SUFFIXES = ".png", ".jpg"
HALF_RANGE = 1.9  # a panel of the plot shows this far to every side of the origin


@dataclass(frozen=True)
class Variant:
    """Parts that a model has, and the sampler for them."""

    sampler: str
    use_flow_head: bool = True
    use_denoise_head: bool = True
    use_dualmod: bool = True


VARIANTS = {
    "both heads": Variant("residual"),
    "flow head": Variant("flow", use_denoise_head=False),
    "denoising head": Variant("ddim", use_flow_head=False),
    "control: no DualMod": Variant("residual", use_dualmod=False),
}


@dataclass(frozen=True)
class Row:
    """Result of a variant on a word, measured on the modes that are meant."""

    variant: str
    word: str
    meant: tuple[float, float]  # share of each mode
    shares: list[float]  # of the samples that are near each mode
    mean_error: float  # largest distance of a mode's mean to the data's; NaN if a mode is empty
    std_error: float  # largest of all modes and dims, as a share of the data's; NaN likewise
    passes: bool

    def figures(self) -> dict[str, float]:
        """Return what the table shows; all but the distance of the means in per cent."""
        left, right = self.shares
        return {
            "left_%": 100 * left,
            "right_%": 100 * right,
            "error_of_means": self.mean_error,
            "error_of_spreads_%": 100 * self.std_error,
        }


class Toy(nn.Module):
    """`FdvlaPolicy` with a layer in place of the vision-language model and a word in place of the prompt."""

    def __init__(self, variant: Variant):
        super().__init__()
        self.words = nn.Embedding(len(WORDS), WIDTH)
        self.segment = ActionSegment(1, 2, WIDTH)
        self.layer = nn.TransformerEncoderLayer(
            WIDTH, nhead=4, dim_feedforward=4 * WIDTH, dropout=0, batch_first=True, norm_first=True
        )
        make_head = partial(Head, WIDTH, WIDTH, 2, WIDTH if variant.use_dualmod else None)
        self.flow_head = make_head() if variant.use_flow_head else None
        self.denoise_head = make_head() if variant.use_denoise_head else None

    def forward(
        self, words_B: Tensor, actions_BKD: Tensor, tau_B: Tensor
    ) -> tuple[Tensor | None, Tensor | None]:
        """Velocity and noise (B, K, D); None for a missing head."""
        states_BKH = self.segment.of_actions(self.layer(self.segment(actions_BKD, tau_B)))
        pooled_BH = self.words(words_B)
        velocity_BKD, noise_BKD = (
            None if head is None else head(states_BKH, head.modulation(pooled_BH))
            for head in (self.flow_head, self.denoise_head)
        )
        return velocity_BKD, noise_BKD


def main() -> None:
    """Train the variants and print how well each samples every word; exit with code 1 if a bar is missed."""
    parser = make_parser(__doc__)
    parser.add_argument("--steps", type=positive, default=1000, help="of training, each variant")
    parser.add_argument("--samples", type=positive, default=1000, help="of each word")
    parser.add_argument("--seed", type=int, default=0)
    add_json_argument(parser)
    parser.add_argument("--plot", type=plot, help="draw the samples into this file")
    args = parser.parse_args()
    if args.samples < MIN_SAMPLES:
        parser.error(f"--samples={args.samples} is too few to measure clouds; at least {MIN_SAMPLES}")
    seconds, samples, rows = {}, {}, []
    for name, variant in VARIANTS.items():
        start = time.process_time()
        toy = train(variant, args.steps, args.seed)
        samples[name] = draw_samples(toy, variant.sampler, args.samples, args.seed)
        seconds[name] = time.process_time() - start
        # the control hears no word
        rows += [
            measure(name, word, WORDS[word] if variant.use_dualmod else BOTH, points_ND)
            for word, points_ND in samples[name].items()
        ]
    print_rows("variant, word", {f"{row.variant}, {row.word}": row.figures() for row in rows})
    if args.plot is not None:
        generator = torch.Generator().manual_seed(args.seed)
        words = {word: torch.full((args.samples,), i) for i, word in enumerate(WORDS)}
        data = {word: draw_points(words_N, generator)[:, 0] for word, words_N in words.items()}
        draw_plot(args.plot, {"data": data, **samples})
    settings = {"steps": args.steps, "samples": args.samples, "seed": args.seed}
    figures = {**settings, "cpu_s": seconds, "rows": [asdict(row) for row in rows]}
    finish(args.json, figures, {f"{row.variant}, {row.word}": row.passes for row in rows})


def plot(text: str) -> Path:
    """Parse the path of a plot that can be written."""
    path = writable(text)
    if path.suffix.lower() not in PLOT_SUFFIXES:
        raise argparse.ArgumentTypeError(f"{text!r} must end in {' or '.join(PLOT_SUFFIXES)}")
    return path


def train(variant: Variant, num_steps: int, seed: int) -> Toy:
    """Train a toy on all words."""
    torch.manual_seed(seed)
    toy, generator = Toy(variant), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(toy.parameters(), LEARNING_RATE)
    scheduler = CosineAnnealingLR(optimizer, num_steps)
    loss_mask_BK = torch.ones(BATCH_SIZE, 1, dtype=torch.bool)
    for _ in range(num_steps):
        words_B = torch.randint(len(WORDS), (BATCH_SIZE,), generator=generator)
        z_BKD = torch.randn(BATCH_SIZE, 1, 2, generator=generator)
        tau_B = draw_tau("uniform", BATCH_SIZE, generator)
        point = path_point(draw_points(words_B, generator), z_BKD, tau_B)
        velocity_BKD, noise_BKD = toy(words_B, point.actions, point.tau)
        weight = CONSISTENCY_LOSS_WEIGHT if variant.use_flow_head and variant.use_denoise_head else 0.0
        loss, _ = joint_loss(velocity_BKD, noise_BKD, point, loss_mask_BK, consistency_loss_weight=weight)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
    return toy.eval()


def draw_points(words_B: Tensor, generator: torch.Generator) -> Tensor:
    """Draw data (B, 1, 2) from the modes that the words mean."""
    shares_BM = torch.tensor([*WORDS.values()])[words_B]
    modes_B = shares_BM.multinomial(1, generator=generator)[:, 0]
    return (MODES_MD[modes_B] + STD * torch.randn(len(words_B), 2, generator=generator))[:, None]


@torch.no_grad()
def draw_samples(toy: Toy, sampler: str, num_samples: int, seed: int) -> dict[str, Tensor]:
    """Return {word: (N, 2) samples}, all from the same noise."""
    noise_NKD = torch.randn(num_samples, 1, 2, generator=torch.Generator().manual_seed(seed))
    heads = {word: partial(toy, torch.full((num_samples,), i)) for i, word in enumerate(WORDS)}
    return {
        word: sample(of_word, noise_NKD, sampler=sampler, num_inference_steps=SAMPLING_STEPS)[:, 0]
        for word, of_word in heads.items()
    }


def measure(variant: str, word: str, meant: tuple[float, float], points_ND: Tensor) -> Row:
    """Compare samples (N, 2) with the data's modes, and with the bars."""
    near_MN = near_modes(points_ND)
    shares = near_MN.float().mean(dim=1).tolist()
    meant_modes = [m for m, share in enumerate(meant) if share]
    clouds = [points_ND[near_MN[m]] for m in meant_modes]
    means_MD = torch.stack([cloud_ND.mean(dim=0) for cloud_ND in clouds])
    variances_MD = torch.stack([cloud_ND.square().mean(dim=0) for cloud_ND in clouds]) - means_MD.square()
    mean_error = (means_MD - MODES_MD[meant_modes]).norm(dim=1).max().item()
    std_error = (variances_MD.sqrt() / STD - 1).abs().max().item()
    bars = [SHARE_BARS[share] for share in meant]
    passes = all(low <= share <= high for share, (low, high) in zip(shares, bars, strict=True))
    passes = passes and mean_error <= MEAN_BAR and std_error <= STD_BAR
    return Row(variant, word, meant, shares, mean_error, std_error, passes)


def near_modes(points_ND: Tensor) -> Tensor:
    """(M, N) bool: which points are near each mode."""
    return torch.cdist(MODES_MD, points_ND) < NEAR


def draw_plot(path: Path, columns: dict[str, dict[str, Tensor]]) -> None:
    """Draw {column: {word: points (N, 2)}}, rings around the modes, and the share of the points in each."""
    figure = Figure(figsize=(2.2 * len(columns), 2.3 * len(WORDS)), layout="constrained")
    panels = figure.subplots(len(WORDS), len(columns), squeeze=False)
    for name, clouds, panels_of_column in zip(columns, columns.values(), panels.T, strict=True):
        panels_of_column[0].set_title(name)
        for panel, points_ND in zip(panels_of_column, clouds.values(), strict=True):
            panel.scatter(*points_ND.T, s=1, color="tab:gray" if name == "data" else "tab:blue")
            shares = near_modes(points_ND).float().mean(dim=1).tolist()
            for (x, y), share in zip(MODES_MD.tolist(), shares, strict=True):
                panel.add_patch(Circle((x, y), NEAR, fill=False, color="tab:red"))
                panel.text(x, -HALF_RANGE + 0.1, f"{share:.1%}", ha="center")
            ends = -HALF_RANGE, HALF_RANGE
            panel.set(xlim=ends, ylim=ends, xticks=[], yticks=[], aspect="equal")
    for panel, word in zip(panels[:, 0], WORDS, strict=True):
        panel.set_ylabel(f'"{word}"')
    figure.suptitle(f"By the word (rows) and what was trained; shares: points within {NEAR:g} of a mode")
    figure.savefig(path)


if __name__ == "__main__":
    main()
