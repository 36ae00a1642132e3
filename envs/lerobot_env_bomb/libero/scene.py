# pyright: reportAttributeAccessIssue=false, reportArgumentType=false
"""LeRobot's LIBERO environment, whose MuJoCo model the perturbation axes change."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, wraps
from typing import Any
from xml.etree import ElementTree

import numpy as np

from lerobot_bomb.envs.perturbation import EpisodeTransform
from lerobot_bomb.libero.episode import RENDER_PRESETS, initial_state_of
from lerobot_env_bomb.libero.stock import LiberoEnv, get_libero_dummy_action, mujoco

CAMERAS = ("agentview", "robot0_eye_in_hand")
ROBOT_PREFIXES = ("robot0_", "gripper0_", "mount0_")
FINGERS = "gripper0_"
HIDDEN_GROUP = 5  # of geoms that are not drawn
# fields of mjModel that the axes and LIBERO's own reset change
EDITED = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "body_subtreemass", "body_invweight0",
    "dof_invweight0", "geom_rgba", "geom_friction", "geom_contype", "geom_conaffinity", "mat_rgba",
    "mat_specular", "mat_shininess",
    "cam_pos", "cam_quat", "cam_fovy", "light_dir", "light_diffuse", "light_specular", "light_ambient",
)  # fmt: skip
HEADLIGHT = ("ambient", "diffuse", "specular")


class LiberoTransform(EpisodeTransform):
    """Effect of one perturbation axis on an episode of LIBERO; frozen once drawn."""

    @classmethod
    def add_bodies(cls, worldbody: ElementTree.Element) -> None:
        """Add all bodies that an episode at any level may need, before the model is compiled."""

    def edit(self, scene: "LiberoScene") -> None:
        """Change the model; objects are not yet at their starting places."""

    def arrange(self, scene: "LiberoScene") -> None:
        """Change where objects and the arm are: `scene.data.qpos`."""

    def release(self, scene: "LiberoScene") -> None:
        """Change the model once objects have come to rest and the first images are taken."""


class LiberoScene(LiberoEnv):
    """LIBERO's environment with transforms; without transforms its episodes are LeRobot's, bit for bit.

    Images that nobody sees are not drawn.
    """

    def __init__(
        self,
        kinds: Sequence[type[LiberoTransform]],
        draws: bool = True,
        render_preset: str = RENDER_PRESETS[0],
        **kwargs: Any,
    ):
        """Make the scene; with `draws=False` the images of its observations are black."""
        super().__init__(**kwargs)
        self.render_preset = render_preset
        self._kinds = kinds  # of the axes that may be on
        self._draws = draws
        self._compiled: dict[str, np.ndarray] = {}
        self._textures: dict[int, np.ndarray] = {}  # of those that were changed, as compiled

    def begin(self, seed: int, transforms: Sequence[LiberoTransform]) -> dict[str, Any]:
        """Start a seed's episode; return its first observation."""
        self._ensure_env()
        self._restore()
        env = self._built
        env.seed(seed)
        with self._drawing(False):
            self._place()
            for each in transforms:
                each.edit(self)
            states: Any = self._init_states
            env.set_init_state(states[initial_state_of(seed, len(states))])
            for each in transforms:
                each.arrange(self)
            if transforms:
                mujoco.mj_forward(self.model, self.data)
            for robot in env.robots:
                robot.controller.use_delta = True
            for _ in range(self.num_steps_wait - 1):
                env.step(get_libero_dummy_action())
        observation, *_ = env.step(get_libero_dummy_action())
        for each in transforms:
            each.release(self)
        for robot in env.robots:
            robot.controller.use_delta = self.control_mode == "relative"
        return self._format_raw_obs(observation)

    def close(self) -> None:
        """Free the model and its renderer."""
        if self._env is not None:
            # robosuite frees textures and buffers by their numbers in whichever context is current
            self._opengl.gl_ctx.make_current()
        super().close()

    @property
    def _built(self) -> Any:
        """LIBERO's environment; its library has no types."""
        return self._env

    @property
    def model(self) -> mujoco.MjModel:
        return self._built.sim.model._model

    @property
    def data(self) -> mujoco.MjData:
        return self._built.sim.data._data

    @property
    def num_initial_states(self) -> int:
        states: Any = self._init_states
        return len(states)

    @cached_property
    def movable(self) -> dict[str, int]:
        """{free object: its body}."""
        return {name: self._body_of(each) for name, each in self._built.env.objects_dict.items()}

    @cached_property
    def fixtures(self) -> dict[str, int]:
        """{fixture: its body}, without table and floor."""
        fixtures = self._built.env.fixtures_dict.items()
        return {name: self._body_of(each) for name, each in fixtures if self._is_body(each)}

    @cached_property
    def wanted(self) -> set[str]:
        """Objects and fixtures that the task is about."""
        sites = self._built.env.object_sites_dict
        names = self._built.env.obj_of_interest
        owners = (sites[name].parent_name if name in sites else name for name in names)
        return {name for name in owners if name is not None}  # a region of the table has no owner

    @cached_property
    def owners(self) -> np.ndarray:
        """(bodies,) the object, fixture or robot that each is part of; else 0, the scene."""
        roots = {*self.movable.values(), *self.fixtures.values()}
        owners = np.zeros(self.model.nbody, int)
        for body in range(1, self.model.nbody):
            parent = self.model.body_parentid[body]
            is_robot = self.model.body(body).name.startswith(ROBOT_PREFIXES)
            owners[body] = body if body in roots else owners[parent] or (body if is_robot else 0)
        return owners

    @cached_property
    def scenery(self) -> np.ndarray:
        """Indices of the visible geoms of table, floor and walls."""
        return np.flatnonzero((self.owners[self.model.geom_bodyid] == 0) & (self.model.geom_group == 1))

    def geoms_of(self, bodies: Sequence[int]) -> np.ndarray:
        """Return the indices of all geoms of objects or fixtures."""
        return np.flatnonzero(np.isin(self.owners[self.model.geom_bodyid], bodies))

    def surfaces(self) -> dict[int, str]:
        """{texture of table or floor: a material that has it}, without walls."""
        found = {}
        for material in np.unique(self.model.geom_matid[self.scenery]).tolist():
            texture = int(self.model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
            name = self.model.material(material).name if material >= 0 else ""
            if name and texture >= 0 and "wall" not in name:
                found[texture] = name
        return found

    def change_texture(self, texture: int, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Change a texture, (H, W, 3) uint8 -> (H, W, 3) uint8; the next reset undoes it."""
        pixels = self._pixels_of(texture)
        self._textures.setdefault(texture, pixels.copy())
        pixels[:] = change(pixels)
        self._upload(texture)

    def touched(self) -> set[str]:
        """Objects and fixtures that the gripper touches now."""
        bodies = self.model.geom_bodyid[self.data.contact.geom]  # (n, 2)
        bodies = np.concatenate([bodies, bodies[:, ::-1]])
        others = self.owners[bodies[self._is_finger[bodies[:, 0]], 1]]
        return {self._names[other] for other in others.tolist() if other in self._names}

    def boxes(self) -> dict[int, np.ndarray]:
        """{body of an object or fixture: (2, 3) metres, lowest and highest corner of its geoms}."""
        model, data = self.model, self.data
        boxes = {}
        for body in (*self.movable.values(), *self.fixtures.values()):
            geoms = self.geoms_of([body])
            pose = data.geom_xmat[geoms].reshape(-1, 3, 3)
            middle = data.geom_xpos[geoms] + (pose @ model.geom_aabb[geoms, :3, None])[..., 0]
            half = (abs(pose) @ model.geom_aabb[geoms, 3:, None])[..., 0]
            boxes[body] = np.stack([(middle - half).min(0), (middle + half).max(0)])
        return boxes

    def corners(self) -> np.ndarray:
        """(n, 3) metres: corners of all objects, of the task's other bodies, and the gripper."""
        boxes = self.boxes()
        bodies = {*self.movable.values(), *self.wanted_bodies()}
        corners = [
            [box[x, 0], box[y, 1], box[z, 2]]
            for box in (boxes[body] for body in sorted(bodies))
            for x in (0, 1)
            for y in (0, 1)
            for z in (0, 1)
        ]
        return np.array([*corners, self.gripper_xyz()])

    def wanted_bodies(self) -> list[int]:
        """Bodies of the objects and fixtures that the task is about."""
        bodies = self.movable | self.fixtures
        return [bodies[name] for name in sorted(self.wanted) if name in bodies]

    def gripper_xyz(self) -> np.ndarray:
        """(3,) metres, position of the gripper."""
        return self.data.body("gripper0_eef").xpos.copy()

    @cached_property
    def _is_finger(self) -> np.ndarray:
        """(bodies,) bool: the body belongs to the gripper."""
        return np.array([self.model.body(body).name.startswith(FINGERS) for body in range(self.model.nbody)])

    @cached_property
    def _names(self) -> dict[int, str]:
        """{body: object or fixture}."""
        return {body: name for name, body in (self.movable | self.fixtures).items()}

    def joints_of_robot(self) -> np.ndarray:
        """(7,) indices of the arm's joints in qpos."""
        return np.array(self._built.robots[0]._ref_joint_pos_indexes)

    def _ensure_env(self) -> None:
        if self._env is not None:
            return
        super()._ensure_env()  # builds the model, and builds it again
        inner = self._built.env
        if self._kinds_with_bodies:
            inner.set_xml_processor(self._with_bodies)
        initialize = inner._initialize_sim

        def initialize_and_remember(*args: Any, **kwargs: Any) -> None:
            initialize(*args, **kwargs)
            if self.render_preset == "fast":
                self._simplify_images()
            self._remember()

        inner._initialize_sim = initialize_and_remember
        inner.hard_reset = True
        self._place()
        # from here on the model is kept and set back: the same episodes in a fraction of the time
        inner.hard_reset = False
        for camera in self.camera_name:
            observable = inner._observables[camera]
            observable._sensor = self._drawn_if_on(camera.removesuffix("_image"), observable._sensor)

    def _place(self) -> None:
        """Reset robosuite itself; LIBERO's wrapper would retry for ever, whatever the error."""
        from robosuite.utils.errors import RandomizationError

        while True:
            try:
                self._built.env.reset()
            except RandomizationError:
                continue
            return

    @property
    def _kinds_with_bodies(self) -> list[type[LiberoTransform]]:
        return [kind for kind in self._kinds if "add_bodies" in kind.__dict__]

    def _with_bodies(self, xml: str) -> str:
        root = ElementTree.fromstring(xml)
        worldbody = root.find("worldbody")
        assert worldbody is not None
        for kind in self._kinds_with_bodies:
            kind.add_bodies(worldbody)
        return ElementTree.tostring(root, encoding="unicode")

    def _drawn_if_on(self, camera: str, sensor: Callable[[Any], Any]) -> Callable[[Any], Any]:
        blank = np.zeros((self.observation_height, self.observation_width, 3), np.uint8)

        @wraps(sensor)  # robosuite reads attributes of it
        def draw(cache: Any) -> Any:
            if not self._draws:
                return blank
            # robosuite draws in the current context: with several environments in one process, that of the
            # last one that was built
            self._opengl.gl_ctx.make_current()
            if self.render_preset == "stock":
                return sensor(cache)
            with self._culled(self.model.camera(camera).id):
                return sensor(cache)

        return draw

    def _simplify_images(self) -> None:
        """Leave out what costs most; call it before the renderer is made, which reads the multisampling."""
        model = self.model
        model.vis.quality.offsamples = 0
        model.mat_reflectance[:] = 0  # each reflecting surface draws the scene once more
        model.light_castshadow[:] = 0

    @contextmanager
    def _culled(self, camera: int) -> Iterator[None]:
        """Hide what a camera does not see: without reflections and shadows, no pixel changes."""
        groups = self.model.geom_group.copy()
        self.model.geom_group[self._is_out_of_view(camera)] = HIDDEN_GROUP
        try:
            yield
        finally:
            self.model.geom_group[:] = groups

    def _is_out_of_view(self, camera: int) -> np.ndarray:
        """(geoms,) bool: the sphere around a geom lies outside of a camera's view."""
        model, data = self.model, self.data
        radius = model.geom_rbound  # 0: an infinite plane
        local = (data.geom_xpos - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)
        aspect = np.array([self.observation_width / self.observation_height, 1])
        slope = aspect * np.tan(np.radians(model.cam_fovy[camera]) / 2)
        beyond_m = (abs(local[:, :2]) + slope * local[:, 2:]) / np.hypot(1, slope)  # it looks along -z
        return (radius > 0) & (beyond_m.max(1) > radius)

    @contextmanager
    def _drawing(self, on: bool) -> Iterator[None]:
        before, self._draws = self._draws, on
        try:
            yield
        finally:
            self._draws = before

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8: the first camera's image, upright.

        It is that of the last observation. Where that was not drawn, it shows the present state, up to a
        simulator step of 2 ms later.
        """
        if self._draws:
            return super().render()
        self._ensure_env()
        with self._drawing(True):
            image = self._built.env._observables[self.camera_name[0]]._sensor({})
        return image[::-1, ::-1]

    def _remember(self) -> None:
        """Remember the model as compiled."""
        model = self.model
        self._compiled = {name: getattr(model, name).copy() for name in EDITED}
        headlight = model.vis.headlight
        self._headlight = {name: getattr(headlight, name).copy() for name in HEADLIGHT}
        self._textures = {}

    def _restore(self) -> None:
        """Undo an earlier episode's changes, in the model and in robosuite."""
        model = self.model
        for name, value in self._compiled.items():
            getattr(model, name)[:] = value
        for name, value in self._headlight.items():
            getattr(model.vis.headlight, name)[:] = value
        for texture, pixels in self._textures.items():
            self._pixels_of(texture)[:] = pixels
            self._upload(texture)
        self._textures = {}
        for robot in self._built.robots:
            robot.gripper.current_action = np.zeros_like(robot.gripper.current_action)

    def _pixels_of(self, texture: int) -> np.ndarray:
        """(H, W, channels) uint8, a view."""
        model = self.model
        height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
        channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
        return model.tex_data[start : start + height * width * channels].reshape(height, width, channels)

    def _upload(self, texture: int) -> None:
        self._opengl.gl_ctx.make_current()
        mujoco.mjr_uploadTexture(self.model, self._opengl.con, texture)

    @property
    def _opengl(self) -> Any:
        return self._built.sim._render_context_offscreen

    def _body_of(self, each: Any) -> int:
        return int(self.model.body(each.root_body).id)

    def _is_body(self, each: Any) -> bool:
        return mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, each.root_body) > 0
