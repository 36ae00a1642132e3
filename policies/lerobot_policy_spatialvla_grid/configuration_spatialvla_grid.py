"""Config of ``spatialvla_grid``."""

from collections.abc import Collection
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import OBS_IMAGES

from lerobot_bomb.actions.grid_report import cells_text
from lerobot_bomb.actions.grid_settings import (
    LAYOUT_FLAG,
    LAYOUTS,
    ActionGroup,
    GridSettings,
    check_groups,
    default_groups,
)
from lerobot_bomb.bomb.observation import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from lerobot_bomb.flags import one_of
from lerobot_bomb.policies.config import TokenVlaConfig
from lerobot_bomb.policies.flag_groups import short_help
from lerobot_bomb.policies.pointing_config import PlacesVlaConfig
from lerobot_bomb.training.policy_flags import check_not_negative, check_positive
from lerobot_bomb.vlm.prompt import check_template
from lerobot_policy_spatialvla_grid.pointing_spatialvla_grid import StoneCells

DEPTH_SOURCES = ("none", "observation", "zoedepth")
PREFIX_ATTENTIONS = ("bidirectional", "causal")
LOSS_VOCABULARIES = ("slot", "full")
DRAFTS = ("none", "repeat")
NUM_STATE_BINS = 256
# flags that say what shapes the weights have, beside the grids' own
SHAPES = ("nano_config", "ego3d_no_depth_vector", "pointing", "pointing_area_m", "pointing_cell_m")
# the same, and flags that say what the model reads and writes
AS_TRAINED = ("chunk_size", "use_state", "prefix_attention", "task_template", *SHAPES)
BARE_TASK = "{}"
WORKSPACE_M = [list(WORKSPACE_LOW_M[:2]), list(WORKSPACE_HIGH_M[:2])]
STONE_CELL_M = 0.005  # a fifth of a stone, and about what a small vision model tells apart


@PreTrainedConfig.register_subclass("spatialvla_grid")
@short_help
@dataclass
class SpatialvlaGridConfig(TokenVlaConfig, PlacesVlaConfig):
    """A PaliGemma 2 chooses a grid cell per group of dims and step; more flags: docs/spatialvla_grid.md."""

    CHOICES: ClassVar[dict[str, tuple]] = {
        **TokenVlaConfig.CHOICES,
        "depth_source": DEPTH_SOURCES,
        "prefix_attention": PREFIX_ATTENTIONS,
        "loss_vocab": LOSS_VOCABULARIES,
        "draft": DRAFTS,
    }
    STATE_IS_OF_WEIGHTS: ClassVar[bool] = False
    LATER_FIELDS: ClassVar[dict[str, Any]] = {
        **PlacesVlaConfig.LATER_FIELDS,
        "task_template": BARE_TASK,
        "pointing_area_m": WORKSPACE_M,
        "pointing_cell_m": STONE_CELL_M,
    }
    FILLED_IN: ClassVar[tuple[str, ...]] = ("grid_params", "depth_config")
    RESEARCH: ClassVar[tuple[str, ...]] = (
        *("grid_distribution", "grid_min_sigma", "decode_point", "zero_radius_bin", "rho_dead", "phi_fit"),
        *(
            "ego3d_patch_reso",
            "ego3d_n_freqs",
            "ego3d_zero_init",
            "ego3d_no_depth_vector",
            "depth_model_name",
        ),
        *("prefix_attention", "loss_vocab", "pointing_area_m", "pointing_cell_m", "task_template", "draft"),
        "freeze_llm_embeddings",
    )

    # Hub id, path of a local folder, or "nano": a small model with random weights, built in code
    vlm_model_name: str = "google/paligemma2-3b-pt-224"

    # actions of a chunk
    chunk_size: int = 4
    # actions executed before the next prediction
    n_action_steps: int = 4
    # what the prompt says around the instruction, for which {} stands; in lower case, too. SpatialVLA's
    # slides have "What action should the robot take to {}?"
    task_template: str = BARE_TASK
    # whether the robot's state, in 256 bins, is in the prompt
    use_state: bool = False

    # [{"dims": [0, 1, 2], "transform": "polar", "bins": [16, 32, 8]}, ...]: one token each a step; None = by
    # `action_layout`
    action_groups: list[dict[str, Any]] | None = None
    # what the action is: a "pose" (x, y, z, gripper; of 7 with three angles before the gripper) or "joints";
    # None = what its dimensions' names say
    action_layout: str | None = None
    # how edges are placed: by the Gaussian or by the quantiles of the data, or evenly
    grid_distribution: str = "gaussian"
    # lower limit of the fitted standard deviations, in normalised units
    grid_min_sigma: float = 0.0
    # what a cell decodes to: "mid" (bin's middle), "cond_mean" (mean of the data within the bin; without any,
    # of the fitted Gaussian) or "centroid" (mean of the data within the cell)
    decode_point: str = "cond_mean"
    # whether a polar group's smallest radius means "no motion" exactly, and up to which it does; None = a
    # fiftieth of the data's long motions
    zero_radius_bin: bool = True
    rho_dead: float | None = None
    # whether the angle phi is cut opposite the data's mean direction ("wrapped") or at pi ("linear")
    phi_fit: str = "wrapped"
    # edges and all else of the grids; filled in from the training data
    grid_params: dict[str, Any] | None = None
    # whether a checkpoint's grids are fitted anew to the data it is trained on, its cells' embeddings moved
    adapt_embeddings: bool = True

    # where depth comes from: "none", "observation" (key observation.depth.CAMERA) or "zoedepth"
    depth_source: str = "none"
    depth_model_name: str = "Intel/zoedepth-nyu-kitti"
    # architecture of that model; filled in when it is loaded, for checkpoints
    depth_config: dict[str, Any] | None = None
    # {camera: 3x3 matrix in pixels of its image}, where the batch has no observation.intrinsics.CAMERA
    camera_intrinsics: dict[str, list[list[float]]] = field(default_factory=dict)
    # 3-D points of a patch, per side
    ego3d_patch_reso: int = 2
    ego3d_n_freqs: int = 8
    # whether the 3-D points change nothing before training
    ego3d_zero_init: bool = True
    # whether a learned vector stands for points without depth; false, as in the original: a patch with such a
    # point gets no 3-D position
    ego3d_no_depth_vector: bool = True

    # "bidirectional": every token of the prompt reads all of it; "causal": what stands before it
    prefix_attention: str = "bidirectional"
    # what a cell competes with in the loss: the cells of its "slot", or the "full" vocabulary
    loss_vocab: str = "slot"

    # x and y in metres, from and to, where stones may be pointed at, and the side of their cells
    pointing_area_m: list[list[float]] = field(default_factory=lambda: deepcopy(WORKSPACE_M))
    pointing_cell_m: float = STONE_CELL_M

    # what a pass guesses beside the next cell: "none", or that a step is as the one before ("repeat"); the
    # cells are the same, up to ties within rounding. Not on CUDA
    draft: str = "repeat"

    # as the original's evaluations on LIBERO, which take 4 chunks
    temporal_ensemble_weighting: str = "adaptive"
    temporal_ensemble_coefficient: float = 0.1

    # side of the crop as a fraction of the image: random place while training, centre otherwise
    crop_fraction: float = 0.9
    # the words' embeddings; those of the cells are always trained
    freeze_llm_embeddings: bool = True

    optimizer_betas: tuple[float, float] = (0.9, 0.999)
    scheduler_warmup_steps: int = 500

    def check_flags(self) -> None:
        super().check_flags()
        if self.action_layout is not None:
            one_of(LAYOUT_FLAG, self.action_layout, LAYOUTS)
        if self.action_feature is not None:
            self._grid_settings(self._given_groups() or ())
        check_template(self.task_template, "--policy.task_template")
        check_not_negative(self, ("grid_min_sigma",))
        check_positive(self, ("ego3d_patch_reso", "ego3d_n_freqs"))
        self.stone_cells()

    def validate_features(self) -> None:
        """Raise unless the dataset (or environment) has what the policy reads and writes."""
        super().validate_features()
        if self.depth_source == "observation":
            self._check_depth()

    def missing_parts(self) -> str | None:
        if self.depth_source == "zoedepth" and self.depth_config is None:
            return f"depth_config, so loading it elsewhere would need {self.depth_model_name}"
        return super().missing_parts()

    def methods(self) -> list[str]:
        kind = self.grid_distribution
        edges = "uniform edges" if kind == "uniform" else f"adaptive edges ({kind})"
        has_depth = self.depth_source != "none"
        return [
            f"{cells_text(self.grid_settings().groups)}, {edges}",
            *super().methods(),
            f"3-D positions by depth ({self.depth_source})" if has_depth else "no depth, no 3-D positions",
        ]

    def stone_cells(self) -> StoneCells:
        """Return where stones may be pointed at.

        Raises:
            ValueError: flags give no cells.
        """
        return StoneCells.of_flags(self.pointing_area_m, self.pointing_cell_m)

    @property
    def prompt_template(self) -> str:
        """`task_template` as it is written."""
        return self.task_template.lower()

    def check_template_as_trained(self) -> None:
        """Raise where a flag asks for another prompt than the checkpoint's processor writes."""
        then = (self.trained_with or {}).get("task_template", BARE_TASK)
        if self.task_template != then:
            raise ValueError(
                f"--policy.task_template={self.task_template!r}: this checkpoint was trained with {then!r}, "
                f"which cannot be changed"
            )

    @property
    def has_positions(self) -> bool:
        """True if patches get anything of Ego3D."""
        return self.depth_source != "none" or self.ego3d_no_depth_vector

    def read_depth_of(self, given: Collection[str] | None) -> None:
        """Let a checkpoint that was trained without observed depth read what observations give.

        ``given``: their keys; None: they are not known yet, and a batch will say what is missing.
        """
        if self.depth_source == "observation":
            read = {
                key: PolicyFeature(FeatureType.STATE, shape)
                for key, shape in self._depth_shapes().items()
                if given is None or key in given
            }
            self.input_features = read | (self.input_features or {})

    def _depth_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the inputs that observed depth consists of; LeRobot takes them for states."""
        shapes: dict[str, tuple[int, ...]] = {}
        for key, feature in self.image_features.items():
            camera = key.removeprefix(f"{OBS_IMAGES}.")
            shapes[f"observation.depth.{camera}"] = tuple(feature.shape[1:])
            if camera not in self.camera_intrinsics:
                shapes[f"observation.intrinsics.{camera}"] = (3, 3)
        return shapes

    def _check_depth(self) -> None:
        given = set(self.input_features or {})
        missing = [key for key in self._depth_shapes() if key not in given]
        if missing:
            raise ValueError(
                f"--policy.depth_source=observation needs {', '.join(missing)}; the inputs are "
                f"{sorted(given)}. Record and evaluate with --env.depth=true, or choose "
                f"--policy.depth_source=none; --policy.camera_intrinsics stands in for intrinsics"
            )

    def grid_settings(self) -> GridSettings:
        """Return the settings with which grids are made for the dataset's actions.

        Raises:
            ValueError: a flag of it is wrong, the groups do not have every action dimension once, or nothing
                says what the dimensions are.
        """
        groups = self._given_groups()
        if groups is None:
            assert self.action_feature is not None
            groups = default_groups(self.action_feature.shape[0], self.action_feature_names)
        return self._grid_settings(groups)

    def _given_groups(self) -> tuple[ActionGroup, ...] | None:
        """Return the groups of a flag or of the checkpoint; None: only the dims' names can tell."""
        assert self.action_feature is not None
        (num_dims,) = self.action_feature.shape
        if self.action_groups is not None:
            groups = tuple(ActionGroup.from_dict(group) for group in self.action_groups)
            check_groups(groups, num_dims)
            return groups
        if self.action_layout is not None:
            return default_groups(num_dims, layout=self.action_layout)
        if self.grid_params is not None:
            return GridSettings.from_dict(self.grid_params["settings"]).groups
        return None

    def _grid_settings(self, groups: tuple[ActionGroup, ...]) -> GridSettings:
        return GridSettings(
            groups,
            distribution=self.grid_distribution,
            min_sigma=self.grid_min_sigma,
            decode_point=self.decode_point,
            zero_radius_bin=self.zero_radius_bin,
            rho_dead=self.rho_dead,
            phi_fit=self.phi_fit,
        )

    def check_grid_as_trained(self, *, is_refitted: bool) -> None:
        """Raise where flags ask for other grids than the checkpoint has, unless new ones are fitted."""
        self._check_action_size()
        if self.grid_params is None:
            return
        then = GridSettings.from_dict(self.grid_params["settings"]).flags()
        for flag, value in self.grid_settings().flags().items():
            # both kinds of mean are in every checkpoint, those of the cells only where they are used
            is_stored = flag == "decode_point" and value != "centroid"
            if value != then[flag] and not is_refitted and not is_stored:
                raise ValueError(
                    f"--policy.{flag}={value!r}: this checkpoint's grids have {then[flag]!r}, which only a "
                    f"training with --policy.adapt_embeddings=true can change"
                )
