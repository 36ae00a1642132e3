// Runs BOMB's model in MuJoCo's WASM: a port of bomb/scene.py, physics.py and actuator.py of lerobot_env_bomb.
import { clip } from "./board.js";
import { board, episode as rules, hand, model as built, observation, robots, scene } from "./constants.js";

const NUM_SUBSTEPS = rules.PHYSICS_HZ / rules.DEFAULT_FPS;
const NUM_TRAVEL = Math.max(1, Math.round(scene.TRAVEL_SHARE * NUM_SUBSTEPS));
const HEADLIGHT = ["headlight.ambient", "headlight.diffuse"];
const CONTACT = ["geom_contype", "geom_conaffinity", "body_gravcomp"]; // of stones that wait out of sight

/**
 * Change arrays of a model at some places: {array: [flat indices, values there]}.
 *
 * @param nominal {array: values} that an edit before this one may have changed: both then scale the value
 */
function applyEdit(model, edit, nominal = new Map()) {
  for (const [name, change] of Object.entries(edit)) {
    if (name === "stone_rgba") continue;
    const [places, values] = change;
    const array = arrayOf(model, name);
    const before = nominal.get(name) ?? array;
    places.forEach((place, i) => {
      const isChanged = array[place] !== before[place];
      array[place] = isChanged ? (array[place] * values[i]) / before[place] : values[i];
    });
  }
}

function arrayOf(model, name) {
  return HEADLIGHT.includes(name) ? model.vis.headlight[name.split(".")[1]] : model[name];
}

export class Scene {
  /**
   * @param mujoco the module of npm's package
   * @param files {xml, exact, textures}: the model, what XML rounds, the textures' bytes
   */
  constructor(mujoco, { xml, exact, textures }) {
    this._mujoco = mujoco;
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.data = new mujoco.MjData(this.model);
    applyEdit(this.model, exact);
    this.model.tex_data.set(textures);
    const { model } = this;
    const names = [...Array(board.NUM_STONES).keys()].map((i) => `stone_${i}`);
    this._bodies = names.map((name) => model.body(name).id);
    this._rims = names.map((name) => model.geom(name).id);
    this._visuals = names.map((name) => model.geom(`${name}_visual`).id);
    this._solids = names.map((name, i) => [
      this._rims[i],
      ...[...Array(built.NUM_FEET).keys()].map((foot) => model.geom(`${name}_foot_${foot}`).id),
    ]);
    const address = (name) => model.jnt_qposadr[model.jnt(name).id];
    this._stoneQpos = names.map(address);
    this._fingers = hand.PAD_SIDES.map((side) => address(`${side}_finger`));
    this._arm = robots.JOINTS.map(address);
    this._pads = hand.PAD_SIDES.map((side) => model.geom(`${side}_pad`).id);
    this._grip = model.site("grip").id;
    const editable = [...scene.EDITABLE, ...CONTACT, ...HEADLIGHT];
    this._nominal = new Map(editable.map((name) => [name, arrayOf(model, name).slice()]));
    this._stoneOfGeom = new Map(this._rims.map((geom, i) => [geom, i]));
  }

  /** Start an episode at rest, with open fingers, in a model with only these edits. */
  reset(episode, edits) {
    const { model, data } = this;
    this._mujoco.mj_resetData(model, data);
    for (const [name, values] of this._nominal) arrayOf(model, name).set(values);
    this._showStones(episode, edits);
    for (const edit of edits) applyEdit(model, edit, this._nominal);
    const restHeightM = board.BOARD.thickness_m + episode.stone_size[1] / 2;
    const { qpos } = data;
    this._stoneQpos.forEach((start, i) => {
      const stone = episode.stones[i];
      const xyz = stone ? [stone[0], stone[1], restHeightM] : scene.PARKED[i];
      qpos.set([...xyz, 1, 0, 0, 0], start);
    });
    this._arm.forEach((start, i) => (qpos[start] = episode.arm[i]));
    for (const finger of this._fingers) qpos[finger] = robots.MAX_HALF_OPENING_M;
    data.ctrl.fill(robots.MAX_HALF_OPENING_M);
    data.mocap_pos.set(episode.gripper);
    this._mujoco.mj_forward(model, data);
  }

  /**
   * Move the gripper towards a position in metres, and open or close it, substep by substep: yields after
   * each, so that a page can draw in between.
   */
  *move(targetXyz, openFingers) {
    const { model, data } = this;
    const start = [...data.mocap_pos];
    const target = targetXyz.map((value, i) =>
      clip(value, observation.WORKSPACE_LOW_M[i], observation.WORKSPACE_HIGH_M[i]),
    );
    const openingM = openFingers ? robots.MAX_HALF_OPENING_M : 0;
    for (let substep = 0; substep < NUM_SUBSTEPS; substep++) {
      const share = Math.min(1, (substep + 1) / NUM_TRAVEL);
      const smooth = 3 * share ** 2 - 2 * share ** 3;
      data.ctrl.fill(openingM);
      data.mocap_pos.set(start.map((value, i) => value + smooth * (target[i] - value)));
      this._mujoco.mj_step(model, data);
      yield;
    }
    this._mujoco.mj_forward(model, data);
  }

  /** Measure the current positions. */
  positions() {
    const { site_xpos: sites, xpos } = this.data;
    const at = (array, index) => [...array.slice(3 * index, 3 * index + 3)];
    return { gripperXyz: at(sites, this._grip), stoneXyz: this._bodies.map((body) => at(xpos, body)) };
  }

  /** Measure the current positions and contacts. */
  measure() {
    const { qpos } = this.data;
    const fingerOpening = this._fingers.reduce((sum, finger) => sum + qpos[finger], 0);
    return { ...this.positions(), fingerOpening, stoneTouched: this._touched() };
  }

  /** [touched by the left, by the right pad] of each stone. */
  _touched() {
    const touched = this._rims.map(() => [false, false]);
    const contacts = this.data.contact;
    for (let i = 0; i < contacts.size(); i++) {
      const contact = contacts.get(i);
      const pair = [contact.geom1, contact.geom2];
      for (const [geom, other] of [pair, [...pair].reverse()]) {
        const pad = this._pads.indexOf(geom);
        const stone = this._stoneOfGeom.get(other);
        if (pad >= 0 && stone !== undefined) touched[stone][pad] = true;
      }
      contact.delete();
    }
    contacts.delete();
    return touched;
  }

  /** Colour the stones in play; hide the others and take contact and weight from them. */
  _showStones(episode, edits) {
    const { model } = this;
    const colors = edits.find((edit) => edit.stone_rgba)?.stone_rgba ?? built.STONE_RGBA;
    this._visuals.forEach((visual, i) => {
      const stone = episode.stones[i];
      const rgba = stone ? colors[board.COLORS[stone[2]]] : scene.HIDDEN_RGBA;
      model.geom_rgba.set(rgba, 4 * visual);
      if (stone) return;
      for (const solid of this._solids[i]) model.geom_contype[solid] = model.geom_conaffinity[solid] = 0;
      model.body_gravcomp[this._bodies[i]] = 1;
    });
  }
}

/** Turns actions into the gripper's command; late and imprecise under the axis `dynamics`. */
export class Actuator {
  /** @param noise standard normal numbers, three for each step; null where the arm is exact */
  constructor(episode, noise) {
    this._noiseM = observation.MAX_STEP_M * (episode.noise ?? 0);
    this._noise = noise;
    this._step = 0;
    // until the first action arrives: stay, with open fingers
    this._pending = Array(episode.latency ?? 0).fill([0, 0, 0, 1]);
  }

  /** An action -> where to go now, in metres, and whether to open the fingers. */
  command(action, gripperXyz) {
    this._pending.push(action);
    const executed = this._pending.shift();
    const target = gripperXyz.map((value, i) => value + observation.MAX_STEP_M * executed[i]);
    if (this._noiseM > 0) {
      target.forEach((value, i) => (target[i] = value + this._noiseM * this._noise[3 * this._step + i]));
    }
    this._step += 1;
    return [target, executed[3] >= 0];
  }

  /** Metres that actions still to be executed will move the gripper. */
  get pendingMotionM() {
    return [0, 1, 2].map((i) =>
      this._pending.reduce((sum, action) => sum + observation.MAX_STEP_M * action[i], 0),
    );
  }

  /** The last gripper command that is still to be executed, or 0. */
  get pendingGripper() {
    return this._pending.at(-1)?.[3] ?? 0;
  }
}
