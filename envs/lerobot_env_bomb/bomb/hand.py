# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Names of the two pads of every hand, and the weld that draws its grip point to the command."""

from lerobot_env_bomb.shared.mujoco_gl import mujoco

PAD_SIDES = ("left", "right")


def weld_to_command(spec: mujoco.MjSpec, hand: mujoco.MjsBody, **site: object) -> None:
    """Add the site `grip` to the hand, and draw it to the mocap body `command`."""
    hand.add_site(name="grip", rgba=[0, 0, 0, 0], **site)
    spec.body("command").add_site(name="command", rgba=[0, 0, 0, 0])
    spec.add_equality(
        name="command",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        name1="grip",
        name2="command",
        solref=[0.01, 0.8],
        solimp=[0.9, 0.9, 0.001, 0.5, 2],
    )
