// One episode: where it starts, and a run of it by the expert.
import { clip } from "./board.js";
import { robots } from "./constants.js";
import { expertAction } from "./expert.js";
import { Judge } from "./judge.js";
import { Actuator } from "./scene.js";

/** The episode of a task with a seed's place in SEEDS, perturbed by {axis: level}. */
export function drawEpisode(suite, task, seedPlace, levels) {
  const nominal = suite.episodes[task][seedPlace];
  const changes = Object.entries(levels).map(([axis, level]) => nominal.axes[axis][level - 1]);
  const edits = [nominal.pattern, ...changes.map((change) => change.edit)]
    .filter((number) => number !== null && number !== undefined)
    .map((number) => suite.edits[number]);
  return Object.assign({}, nominal, ...changes, { stones: stonesOf(nominal.stones, changes), edits });
}

/** The stones of an episode whose axes each move or add some of them. */
function stonesOf(nominal, changes) {
  const stones = [...nominal];
  for (const each of changes) {
    each.stones?.forEach((stone, i) => {
      if (String(stone) !== String(nominal[i])) stones[i] = stone;
    });
  }
  return stones;
}

/** A run of an episode, to be advanced substep by substep. */
export class Run {
  /**
   * @param words instead of the episode's instruction; null: none
   * @param noise of the arm, where the axis `dynamics` is on
   * @param act called with the run: its next action, or a promise of it; the expert's by default
   */
  constructor(sceneOfRun, suite, episode, { words = null, noise, act = actAsExpert } = {}) {
    this.act = act;
    this._words = words;
    this.isWaiting = false; // for a promised action
    this.scene = sceneOfRun;
    this.episode = episode;
    this.steps = 0;
    this.hasEnded = false;
    this.maxSteps = suite.max_steps;
    sceneOfRun.reset(episode, episode.edits);
    this.now = sceneOfRun.measure();
    this.judge = new Judge(episode, suite, this.now);
    this.actuator = new Actuator(episode, noise);
    this._substeps = this._simulate();
  }

  get instruction() {
    const { instructions } = this.episode;
    if (this._words !== null) return this._words;
    return instructions[Math.min(this.judge.numMade, instructions.length - 1)];
  }

  /** Make a substep; return false once the episode has ended. */
  advance() {
    return !this._substeps.next().done;
  }

  /** Run to the end. */
  async finish() {
    while (this.advance()) {
      while (this.isWaiting) await new Promise((next) => setTimeout(next));
    }
  }

  *_simulate() {
    while (!this.hasEnded) {
      const action = (yield* this._action()).map((value) => clip(Math.fround(value), -1, 1));
      const [target, openFingers] = this.actuator.command(action, this.now.gripperXyz);
      yield* this.scene.move(target, openFingers);
      this.now = this.scene.measure();
      this.steps += 1;
      this.hasEnded = this.judge.update(this.now);
      if (!this.hasEnded && this.steps >= this.maxSteps) {
        this.judge.timeOut();
        this.hasEnded = true;
      }
    }
  }

  /** The next action; where it is promised, yields until it is there. */
  *_action() {
    let [action, error] = [this.act(this), null];
    if (!(action instanceof Promise)) return action;
    this.isWaiting = true;
    const arrive = (value, reason) => {
      [action, error] = [value, reason];
      this.isWaiting = false;
    };
    action.then((value) => arrive(value, null), (reason) => arrive(null, reason));
    while (this.isWaiting) yield;
    if (error !== null) throw error;
    return action;
  }
}

/** The expert's action. Observations and actions are float32, as between Python's policy and environment. */
function actAsExpert({ judge, now, actuator }) {
  const state = {
    gripperXyz: now.gripperXyz.map(Math.fround),
    fingerOpening: Math.fround(now.fingerOpening),
    goals: judge.goals().map((goal) => ({ ...goal, xyz: goal.xyz.map(Math.fround) })),
    stoneXyz: now.stoneXyz.map((xyz) => xyz.map(Math.fround)),
    stoneRadiusM: Math.fround(judge.layout.stoneRadiusM),
    maxOpeningM: Math.fround(2 * robots.MAX_HALF_OPENING_M),
    pendingMotionM: actuator.pendingMotionM.map(Math.fround),
    pendingGripper: Math.fround(actuator.pendingGripper),
  };
  return expertAction(state);
}
