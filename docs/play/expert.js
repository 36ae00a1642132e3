// The scripted expert: a port of bomb/expert.py, for relative control.
import { clip, minus, norm } from "./board.js";
import { episode, expert as E, observation } from "./constants.js";

// of a step, each way; the page's control rate is the default one
const LIMIT_M = E.SPEED_M_S / episode.DEFAULT_FPS;

/**
 * The action that brings each goal's stone to its place: x, y, z in units of the largest step, gripper.
 *
 * @param state {gripperXyz, fingerOpening, goals, stoneXyz, stoneRadiusM, maxOpeningM, pendingMotionM,
 *   pendingGripper}
 */
export function expertAction(state) {
  const motion = [0, 0, 0];
  let gripper = 0;
  for (const [goal, share] of shares(state)) {
    const plan = planFor(anticipate({ ...state, goal }));
    plan.motion.forEach((value, i) => (motion[i] += share * value));
    gripper += share * plan.gripper;
  }
  return [...motion.map((value) => clip(value / observation.MAX_STEP_M, -1, 1)), gripper];
}

/** The goals that an action serves, with their shares: the goal after the last one reached. */
function shares(state) {
  const { goals } = state;
  const found = [];
  let left = 1;
  for (let i = goals.length - 1; i > 0; i--) {
    const isReached = reached(state, goals[i - 1]);
    if (isReached > 0) {
      found.push([goals[i], left * isReached]);
      left *= 1 - isReached;
    }
  }
  if (left > 0) found.push([goals[0], left]);
  return found;
}

/** How far, in [0, 1], the goal's stone lies on its place with the fingers off it. */
function reached(state, goal) {
  const stone = state.stoneXyz[goal.stone];
  const lateral = lateralM(goal.xyz, stone);
  const height = Math.abs(stone[2] - goal.xyz[2]);
  const lies = (1 - ramp(lateral, E.REACHED_LATERAL_M)) * (1 - ramp(height, E.REACHED_HEIGHT_M));
  const above = state.gripperXyz[2] - graspZ(stone);
  const beside = lateralM(state.gripperXyz, stone);
  return lies * Math.max(ramp(above, E.OFF_ABOVE_M), ramp(beside, E.OFF_BESIDE_M));
}

/** The state after the commands that latency still holds back. */
function anticipate(state) {
  const { goal, pendingMotionM, pendingGripper } = state;
  const held = heldShare(state, state.stoneXyz[goal.stone]);
  const stone = state.stoneXyz[goal.stone].map((value, i) => value + held * pendingMotionM[i]);
  const gripperXyz = state.gripperXyz.map((value, i) => value + pendingMotionM[i]);
  const after = { ...state, gripperXyz, stone };
  if (pendingGripper === 0) return after;
  const closed = enclosed(after, stone) * (2 * state.stoneRadiusM - E.SQUEEZE_M);
  const fingerOpening = pendingGripper > 0 ? state.maxOpeningM : Math.min(closed, state.fingerOpening);
  return { ...after, fingerOpening };
}

/** Displacement in metres, and gripper command in [-1, 1]. */
function planFor(state) {
  const isPlaced = placed(state);
  const isHeld = heldShare(state, state.stone);
  const approach = approachFor(state);
  const carry = state.goal.isSlid ? slide(state) : carryFor(state);
  const retreat = retreatFor(state);
  const motion = retreat.map(
    (value, i) => isPlaced * value + (1 - isPlaced) * (isHeld * carry[i] + (1 - isHeld) * approach.motion[i]),
  );
  const gripper = isPlaced + (1 - isPlaced) * ((1 - isHeld) * approach.gripper - isHeld);
  return { motion, gripper };
}

/** How well the stone lies on the target, in [0, 1]; wider fingers tolerate more. */
function placed(state) {
  const { goal, stone } = state;
  const openness = opennessOf(state, [E.HELD_SHARE[0], E.OPEN_SHARE[0]]);
  const lateral = lateralM(goal.xyz, stone);
  let height = stone[2] - goal.xyz[2];
  // fingers that are as low as they go cannot lower a stone that they hold too high
  height = Math.max(Math.min(height, state.gripperXyz[2] - E.FLOOR_M), height - E.GRASP_SLACK_M);
  const inside = Math.min(
    1 - lateral / between(openness, E.RELEASE_LATERAL_M),
    1 - height / between(openness, E.RELEASE_HEIGHT_M),
  );
  return ramp(inside, E.RELEASE_SHARE);
}

/** How firmly the fingers hold the stone, in [0, 1]. */
function heldShare(state, stone) {
  const play = state.fingerOpening - 2 * state.stoneRadiusM;
  return enclosed(state, stone) * (1 - opennessOf(state, E.HELD_SHARE)) * ramp(play, E.EMPTY_M);
}

/** How far the fingers are open, in [0, 1], between two shares of their play around a stone. */
function opennessOf(state, ends) {
  const diameter = 2 * state.stoneRadiusM;
  return ramp((state.fingerOpening - diameter) / (state.maxOpeningM - diameter), ends);
}

/** How far the stone is between the pads, in [0, 1]. */
function enclosed(state, stone) {
  const offset = minus(stone, state.gripperXyz);
  const beside = 1 - ramp(norm(offset.slice(0, 2)), E.ENCLOSED_BESIDE_M);
  return beside * ramp(offset[2], E.ENCLOSED_BELOW_M) * (1 - ramp(offset[2], E.ENCLOSED_ABOVE_M));
}

/** Bring open fingers around the stone and close them. */
function approachFor(state) {
  const { stone, gripperXyz } = state;
  const offsetXy = minus(stone, gripperXyz).slice(0, 2);
  const lateral = norm(offsetXy);
  const above = gripperXyz[2] - graspZ(stone);
  const funnel = clip((lateral - E.FUNNEL_MOUTH_M) * E.FUNNEL_SLOPE, 0, E.HOVER_M);
  // closed fingers would come down on the stone
  const shut = E.HOVER_M * (1 - opennessOf(state, E.OPEN_SHARE)) * (1 - enclosed(state, stone));
  const rise = Math.max(funnel, shut) - E.PRESS_M - above;
  // away from the stone, low fingers would sweep others off the board: first up, then across
  const freedom = Math.max(ramp(above, E.FREE_ABOVE_M), 1 - ramp(lateral, E.FREE_BESIDE_M));
  const inside = Math.min(
    1 - lateral / E.CLOSE_LATERAL_M,
    1 - above / E.CLOSE_HEIGHT_M,
    (state.fingerOpening - 2 * state.stoneRadiusM - E.EMPTY_M[0]) / E.CLOSE_HEIGHT_M,
  );
  return { motion: step(offsetXy, rise, freedom), gripper: clip(-E.CLOSE_GAIN * inside, -1, 1) };
}

/** Bring the held stone over the target and down. */
function carryFor({ goal, stone }) {
  const offsetXy = minus(goal.xyz, stone).slice(0, 2);
  const height = stone[2] - goal.xyz[2];
  const funnel = clip((norm(offsetXy) - E.CARRY_MOUTH_M) * E.CARRY_SLOPE, 0, E.CARRY_M);
  const freedom = Math.max(ramp(height, E.CLEARANCE_M), E.CREEP_M / LIMIT_M);
  return step(offsetXy, funnel - E.PRESS_M - height, freedom);
}

/** Draw the stone between the pads along the board to the target. */
function slide({ goal, stone }) {
  const offset = minus(goal.xyz, stone);
  return step(offset.slice(0, 2), offset[2], E.SLIDE_M / LIMIT_M);
}

/** Straight up, as soon as the fingers are clear of the stone. */
function retreatFor(state) {
  const rise = Math.max(0, E.RETREAT_HEIGHT_M - state.gripperXyz[2]) * opennessOf(state, E.OPEN_SHARE);
  return step([0, 0], rise, 1);
}

/** Height in metres of the gripper that grasps the stone. */
function graspZ(stone) {
  return Math.max(stone[2] - E.GRASP_DEPTH_M, E.FLOOR_M);
}

/** The part of the way that one step covers; `freedom` in [0, 1] slows it sideways. */
function step(offsetXy, rise, freedom) {
  const wanted = offsetXy.map((value) => E.GAIN * value);
  const length = norm(wanted);
  const share = length > 0 ? Math.min(1, (freedom * LIMIT_M) / length) : 1;
  return [...wanted.map((value) => value * share), clip(E.GAIN * rise, -LIMIT_M, LIMIT_M)];
}

function lateralM(a, b) {
  return norm(minus(a, b).slice(0, 2));
}

/** 0 at the first end, 1 at the second, constant beyond both. */
function ramp(value, [low, high]) {
  return clip((value - low) / (high - low), 0, 1);
}

function between(share, [low, high]) {
  return low + share * (high - low);
}
