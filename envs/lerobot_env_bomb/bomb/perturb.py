"""Draws an episode under its condition: one frozen transform per axis that is on."""

from dataclasses import dataclass, field, replace

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.suite import Episode, find_suite
from lerobot_bomb.envs.perturbation import EpisodePerturbation
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.bomb.scene import ModelEdit


@dataclass(frozen=True)
class Perturbation(EpisodePerturbation[Transform]):
    """An episode's axes that are on, in the order of AXES."""

    @property
    def model_edits(self) -> tuple[ModelEdit, ...]:
        """Edits of the compiled model."""
        return tuple(each.edit_model for each in self.transforms.values())

    def arrange(self, layout: Layout, supply: tuple[int, ...]) -> Layout:
        """Return the layout after all changes; `supply`: indices of the stones in the tray."""
        for each in self.transforms.values():
            layout = each.arrange(layout, supply)
        return layout


@dataclass(frozen=True)
class PerturbedEpisode(Episode):
    """An episode with its condition's instruction and layout; the model is still to be edited."""

    perturbation: Perturbation = field(kw_only=True)


def sample_episode(spec: EpisodeSpec) -> PerturbedEpisode:
    """Draw the suite's episode, then its perturbation; the same spec gives the same episode."""
    return perturb(find_suite(spec.suite).sample(spec))


def perturb(nominal: Episode) -> PerturbedEpisode:
    """Draw the perturbation of an episode's condition, and apply it to instruction and layout."""
    perturbation = draw_perturbation(nominal)
    changed = {
        "turns": tuple(
            replace(turn, instruction=perturbation.reword(turn.instruction, replace(nominal, turns=(turn,))))
            for turn in nominal.turns
        ),
        "layout": perturbation.arrange(nominal.layout, nominal.supply),
    }
    return PerturbedEpisode(**{**vars(nominal), **changed}, perturbation=perturbation)


def draw_perturbation(nominal: Episode) -> Perturbation:
    """Draw the axes of the episode's condition, each from a generator of its own."""
    return Perturbation.draw(nominal.spec.condition, nominal.spec.seed, nominal)
