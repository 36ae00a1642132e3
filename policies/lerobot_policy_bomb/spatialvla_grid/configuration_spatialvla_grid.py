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
from lerobot_policy_bomb.spatialvla_grid.pointing_spatialvla_grid import StoneCells

DEPTH_SOURCES = ("none", "observation", "zoedepth")
PREFIX_ATTENTIONS = ("bidirectional", "causal")
LOSS_VOCABULARIES = ("slot", "full")
DRAFTS = ("none", "repeat")
NUM_STATE_BINS = 256
# flags that say what shapes the weights have, beside the grids' own
SHAPES = ("nano_config", "ego3d_no_depth_vector", "pointing", "pointing_area_m", "pointing_cell_m")
# those, and flags that say what the model reads and writes
AS_TRAINED = ("chunk_size", "use_state", "prefix_attention", "task_template", *SHAPES)
BARE_TASK = "{}"
WORKSPACE_M = [list(WORKSPACE_LOW_M[:2]), list(WORKSPACE_HIGH_M[:2])]
STONE_CELL_M = 0.005  # a fifth of a stone, and about what a small vision model tells apart


@PreTrainedConfig.register_subclass("spatialvla_grid")
@short_help
@dataclass
class SpatialvlaGridConfig(TokenVlaConfig, PlacesVlaConfig):
    """A PaliGemma 2 chooses a grid cell per group and step; more flags: docs/reference/policies.md."""

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
        *("ego3d_patch_reso", "ego3d_n_freqs", "ego3d_zero_init", "ego3d_no_depth_vector"),
        *("prefix_attention", "loss_vocab", "pointing_area_m", "pointing_cell_m", "task_template", "draft"),
        *("depth_model_name", "freeze_llm_embeddings"),
    )

    # base model: Hub id, local folder, or "nano", a small model with random weights that needs no network
    vlm_model_name: str = "google/paligemma2-3b-pt-224"

    # actions predicted at once
    chunk_size: int = 4
    # actions executed before the next prediction
    n_action_steps: int = 4
    # text around the instruction, which {} stands for, in lower case. SpatialVLA's slides have "What action
    # should the robot take to {}?"
    task_template: str = BARE_TASK
    # put the robot's state into the prompt
    use_state: bool = False

    # groups of action dimensions, a token each per step: [{"dims": [0, 1, 2], "transform": "polar", "bins":
    # [16, 32, 8]}, ...]; transforms are polar, identity, binary; unset: by action_layout
    action_groups: list[dict[str, Any]] | None = None
    # kind of action: "pose" (x, y, z, gripper; of 7 with three angles before the gripper) or "joints";
    # unset: by the dimensions' names
    action_layout: str | None = None
    # how edges are placed: by a Gaussian fitted to the data, by its quantiles (quantile), or evenly (uniform)
    grid_distribution: str = "gaussian"
    # lower limit of the fitted standard deviations, normalised
    grid_min_sigma: float = 0.0
    # value of a cell: "mid" (the bin's middle), "cond_mean" (mean of the data in the bin; without data, of
    # the fitted Gaussian) or "centroid" (mean of the data in the cell)
    decode_point: str = "cond_mean"
    # let the smallest radius of a polar group mean exactly "no motion"
    zero_radius_bin: bool = True
    # length up to which an action is no motion; unset: a fiftieth of the data's long motions
    rho_dead: float | None = None
    # cut the angle phi opposite the data's mean direction ("wrapped") or at pi ("linear")
    phi_fit: str = "wrapped"
    # edges and all else of the grids, fitted to the training data
    grid_params: dict[str, Any] | None = None
    # fit a checkpoint's grids again to new training data, and move the cells' embeddings with them; not with
    # keep_statistics
    adapt_embeddings: bool = True

    # source of depth: "none", "observation" (key observation.depth.CAMERA) or "zoedepth"
    depth_source: str = "none"
    # Hub id or folder of ZoeDepth, for checkpoints without their own
    depth_model_name: str = "Intel/zoedepth-nyu-kitti"
    # architecture of the depth model
    depth_config: dict[str, Any] | None = None
    # {camera: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]} in pixels of the whole image, for data without
    # observation.intrinsics.CAMERA
    camera_intrinsics: dict[str, list[list[float]]] = field(default_factory=dict)
    # 3-D points along a side of a patch
    ego3d_patch_reso: int = 2
    # frequencies by which a 3-D point is encoded
    ego3d_n_freqs: int = 8
    # let the 3-D points have no effect before training
    ego3d_zero_init: bool = True
    # use a learned vector for points without depth; false, as in the original: a patch with such a point
    # gets no 3-D position
    ego3d_no_depth_vector: bool = True

    # tokens of the prompt attend to all of it ("bidirectional") or to earlier tokens ("causal")
    prefix_attention: str = "bidirectional"
    # classes in the loss of a cell: the cells of its "slot", or the "full" vocabulary
    loss_vocab: str = "slot"

    # area in which stones may be, in metres: [[x, y] from, [x, y] to]
    pointing_area_m: list[list[float]] = field(default_factory=lambda: deepcopy(WORKSPACE_M))
    # side of a cell of that area in metres
    pointing_cell_m: float = STONE_CELL_M

    # guess that a step equals the one before ("repeat"), or guess nothing ("none"). The cells are the same,
    # up to ties within rounding. Used for batches of 1, not on CUDA
    draft: str = "repeat"

    # weights in the ensemble's mean: "uniform", "exponential" (exp(coefficient * age)), "nvlabs" (1 for the
    # newest, 0.5 for others) or "adaptive" (exp(coefficient * cosine with the newest action))
    temporal_ensemble_weighting: str = "adaptive"
    # coefficient of these weights; with "exponential" above 0 favours old chunks
    temporal_ensemble_coefficient: float = 0.1

    # side of the crop as a share of the image's; placed at random in training, centred in evaluation
    crop_fraction: float = 0.9
    # do not train the words' embeddings; those of the cells are always trained
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
        """Raise unless the dataset or environment has all features that the policy reads and writes."""
        super().validate_features()
        if self.depth_source == "observation":
            self._check_depth()

    def missing_parts(self) -> str | None:
        if self.depth_source == "zoedepth" and self.depth_config is None:
            return f"depth_config, so loading it elsewhere would need {self.depth_model_name}"
        return super().missing_parts()

    def methods(self) -> list[str]:
        kind = self.grid_distribution
        edges = "uniform edges" if kind == "uniform" else f"adaptive {kind} edges"
        has_depth = self.depth_source != "none"
        return [
            cells_text(self.grid_settings().groups, edges),
            *super().methods(),
            f"3-D positions by depth ({self.depth_source})" if has_depth else "no depth, no 3-D positions",
        ]

    def stone_cells(self) -> StoneCells:
        """Return the cells in which stones may be pointed at.

        Raises:
            ValueError: flags give no cells.
        """
        return StoneCells.of_flags(self.pointing_area_m, self.pointing_cell_m)

    @property
    def prompt_template(self) -> str:
        """`task_template` in lower case."""
        return self.task_template.lower()

    def check_template_as_trained(self) -> None:
        """Raise if a flag asks for another prompt than the checkpoint's processor writes."""
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
        """Let a checkpoint that was trained without observed depth read the observations' depth.

        ``given``: the observations' keys; None if unknown yet, so that a batch reports what is missing.
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
            ValueError: a flag is wrong, the groups do not have every action dimension once, or nothing says
                what the dimensions are.
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
        """Raise if flags ask for other grids than the checkpoint has, unless new ones are fitted."""
        if self.grid_params is None:
            return
        then = GridSettings.from_dict(self.grid_params["settings"]).flags()
        for flag, value in self.grid_settings().flags().items():
            # both kinds of mean are in every checkpoint, those of the cells only where they are used
            is_stored = flag == "decode_point" and value != "centroid"
            if value != then[flag] and not is_refitted and not is_stored:
                raise ValueError(
                    f"--policy.{flag}={value!r}: this checkpoint's grids have {then[flag]!r}, which only a "
                    f"training with --policy.adapt_embeddings=true and new statistics can change"
                )
