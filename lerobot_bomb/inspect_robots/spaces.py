"""BOMB's actions and observations in the words of Inspect Robots."""

from inspect_robots.spaces import (
    ActionSemantics,
    Box,
    CameraSpec,
    ControlMode,
    ObservationSpace,
    StateField,
    StateSpec,
)

from lerobot_bomb.bomb.observation import (
    ACTION_NAMES,
    AGENT_POS,
    CAMERAS,
    MAX_STEP_M,
    STATE_DIM,
    WORKSPACE_HIGH_M,
    WORKSPACE_LOW_M,
    action_bounds,
)

# value of --env.control_mode -> its name in Inspect Robots
CONTROL_MODES: dict[str, ControlMode] = {
    "relative": "eef_delta_pos",
    "absolute": "eef_abs_pose",
    "joints": "joint_pos",
}
UNITS = {
    "relative": f"{MAX_STEP_M:g} m times dx, dy, dz is how far the gripper goes from where it is",
    "absolute": "x, y, z is the point in metres to which the gripper goes",
}
# what a policy that reads text must know, beside the names and bounds of the actions
NOTES = """\
World frame: metres; origin on the table below the board's centre.
x points along columns, y towards the far row, z up.
Action: {units}; gripper >= 0 opens the fingers, < 0 closes them.
State: eef_pos is the point between the fingers' lower ends, gripper_width the distance between the pads.
The gripper's point stays within x {x}, y {y}, z {z} m."""


def action_box(control_mode: str) -> Box:
    """Return the box of actions of a value of --env.control_mode."""
    low, high = action_bounds(control_mode)
    semantics = ActionSemantics(
        CONTROL_MODES[control_mode],
        gripper="continuous" if control_mode == "joints" else "binary",
        frame="base" if control_mode == "joints" else "world",
        dim_labels=ACTION_NAMES[control_mode],
    )
    return Box(low.shape, low, high, semantics)


def observed_space(image_size: int) -> ObservationSpace:
    """Return both cameras, and the state twice: in one array, as policies read it, and by its parts."""
    cameras = tuple(CameraSpec(name, image_size, image_size) for name in CAMERAS)
    fields = (
        StateField(AGENT_POS, (STATE_DIM,), "m", "float32"),
        StateField("eef_pos", (3,), "m", "float32"),
        StateField("gripper_width", (1,), "m", "float32"),
    )
    return ObservationSpace(cameras, state=StateSpec(fields))


def notes(control_mode: str) -> str:
    """Return what a policy that reads text needs to know of the arm."""
    x, y, z = (f"{low:g} to {high:g}" for low, high in zip(WORKSPACE_LOW_M, WORKSPACE_HIGH_M, strict=True))
    return NOTES.format(units=UNITS[control_mode], x=x, y=y, z=z)
