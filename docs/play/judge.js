// Judge of an episode: a port of bomb/judge.py.
import { distanceM, intersectionXy, keyOf, minus, nearestIntersection, norm } from "./board.js";
import { board, episode as rules, judge as limits, move as moves } from "./constants.js";
import { courseGoals, layoutOf, openMoves, placesLeft, stonesLeft } from "./moves.js";

const STONES = [...Array(board.NUM_STONES).keys()];

export class Judge {
  /**
   * @param episode what is asked for
   * @param suite its step limit and number of goals
   * @param start what the simulator measured at the start
   */
  constructor(episode, suite, start) {
    this.stage = "start";
    this.failure = null;
    this.isSuccess = false;
    this.collateralMm = 0;
    this.layout = layoutOf(episode);
    this._episode = episode;
    this._numGoals = suite.num_goals;
    this._plans = episode.plans.map((plan) => ({ plan, made: new Map() }));
    this._isComplete = false;
    this._movable = this._findMovable();
    this._stone = episode.first_stone;
    this._leftXyz = start.stoneXyz.map((xyz) => [...xyz]);
    this._now = start;
    this._wasLifted = STONES.map(() => false);
    this._lastTouchedZ = start.stoneXyz.map((xyz) => xyz[2]);
    this._restSteps = STONES.map(() => 0);
  }

  get numMade() {
    return Math.max(...this._plans.map(({ made }) => made.size)) + this._isComplete;
  }

  get numMoves() {
    return this._plans[0].plan.length;
  }

  get placementErrorMm() {
    return 1e3 * Math.min(...this._places().map((place) => distanceM(this._xy(this._stone), place)));
  }

  get nearestIntersection() {
    return nearestIntersection(this._xy(this._stone));
  }

  /** The expert's goals, as many as the suite has at most: the last one is repeated if need be. */
  goals() {
    const goals = courseGoals(this._furthestCourse(), this.layout, this._now.stoneXyz);
    while (goals.length < this._numGoals) goals.push(goals.at(-1));
    return goals;
  }

  /** Update with the state after a control step; return true if the episode has ended. */
  update(now) {
    const touched = now.stoneTouched.map(([left, right]) => left || right);
    const held = now.stoneTouched.map(([left, right]) => left && right);
    for (const i of STONES) {
      const speed = norm(minus(now.stoneXyz[i], this._now.stoneXyz[i])) * rules.DEFAULT_FPS;
      this._restSteps[i] = !touched[i] && speed < limits.REST_SPEED_M_S ? this._restSteps[i] + 1 : 0;
      const isHigh = now.stoneXyz[i][2] > this.layout.restHeightM + limits.LIFT_M;
      this._wasLifted[i] ||= held[i] && isHigh;
      if (touched[i]) this._lastTouchedZ[i] = now.stoneXyz[i][2];
    }
    this._now = now;
    this._follow(touched, held);
    for (const i of STONES) {
      const movedMm = 1e3 * norm(minus(now.stoneXyz[i], this._leftXyz[i]));
      if (!this._movable.has(i)) this.collateralMm = Math.max(this.collateralMm, movedMm);
    }
    this._updateStage(held[this._stone]);

    const carried = [...this._wasLifted];
    // a stone that was pushed, not carried, to its place lies there all the same
    for (const stone of this._movable) carried[stone] ||= this._isAtPlace(stone);
    const restSteps = Math.ceil(limits.REST_S * rules.DEFAULT_FPS);
    const ended = STONES.filter((i) => carried[i] && this._restSteps[i] >= restSteps);
    const placed = ended.find((i) => this._movable.has(i));
    if (placed !== undefined) return this._judgePlacement(placed);
    if (ended.length > 0) this.failure = "wrong_stone";
    return ended.length > 0;
  }

  /** Set the failure of an episode that has run out of time. */
  timeOut() {
    const touched = this._now.stoneTouched[this._stone];
    const wasLifted = this._wasLifted[this._stone];
    const isTouched = touched.some(Boolean);
    if (this._wasLifted.some(Boolean) && !wasLifted) this.failure = "wrong_stone";
    else if (this.stage === "start") this.failure = "never_reached";
    else if (touched.every(Boolean) || (wasLifted && (isTouched || this._isAtPlace(this._stone)))) {
      this.failure = "timeout_holding";
    } else this.failure = wasLifted ? "dropped" : "missed_grasp";
  }

  _xy(stone) {
    return this._now.stoneXyz[stone].slice(0, 2);
  }

  /** The course of the plan that has come furthest, as far as instructions have named it. */
  _furthestCourse() {
    const byTurns = this._episode.instructions.length > 1;
    const courses = this._plans.map(({ plan, made }) =>
      this._course(byTurns ? plan.slice(0, made.size + 1) : plan, made),
    );
    const isFurther = (a, b) => a.lying.size - b.lying.size || (a.carried !== null) - (b.carried !== null);
    return courses.reduce((best, each) => (isFurther(each, best) > 0 ? each : best));
  }

  /** How far a plan has come, by what lies in place and what the fingers carry. */
  _course(plan, made) {
    const isHeld = (stone) => this._now.stoneTouched[stone].every(Boolean);
    const lying = new Map(made);
    const inOrder = (move) => [...stonesLeft(move, lying)].sort((a, b) => a - b);
    for (const [number, move] of openMoves(plan, lying)) {
      for (const stone of inOrder(move)) {
        if (!this._isFlat(stone) || isHeld(stone)) continue;
        const [place] = this._placesUnder(stone, move, lying);
        if (place === undefined) continue;
        lying.set(number, { stone, place });
        break;
      }
    }
    for (const [number, move] of openMoves(plan, lying)) {
      const stone = inOrder(move).find((each) => isHeld(each) || this._wasLifted[each]);
      if (stone !== undefined) return { plan, made, lying, carried: { number, stone } };
    }
    return { plan, made, lying, carried: null };
  }

  /** The open moves of all plans, each with what its plan has made. */
  *_openMoves() {
    for (const { plan, made } of this._plans) {
      for (const [number, move] of openMoves(plan, made)) yield { plan, made, number, move };
    }
  }

  _findMovable() {
    const stones = [...this._openMoves()].flatMap(({ move, made }) => stonesLeft(move, made));
    return new Set(stones.sort((a, b) => a - b));
  }

  /** The places to which the followed stone may come. */
  _places() {
    return [...this._openMoves()]
      .filter(({ move, made }) => stonesLeft(move, made).includes(this._stone))
      .flatMap(({ move, made }) => placesLeft(move, made));
  }

  /** Switch to the stone that is held or touched, where several may be moved. */
  _follow(touched, held) {
    if (this._movable.size < 2) return;
    const movable = [...this._movable];
    const gripped = movable.find((i) => held[i]) ?? movable.find((i) => touched[i]);
    if (gripped !== undefined && !touched[this._stone]) this._stone = gripped;
  }

  _updateStage(isHeld) {
    const offset = minus(this._now.gripperXyz, this._now.stoneXyz[this._stone]);
    const isBeside = norm(offset.slice(0, 2)) < this.layout.stoneRadiusM;
    const reached = {
      reached: isBeside && offset[2] < this.layout.stoneHeightM / 2,
      grasped: isHeld,
      lifted: this._wasLifted[this._stone],
    };
    for (const [stage, isReached] of Object.entries(reached)) {
      if (isReached && rules.STAGES.indexOf(stage) > rules.STAGES.indexOf(this.stage)) this.stage = stage;
    }
  }

  _isFlat(stone) {
    return Math.abs(this._now.stoneXyz[stone][2] - this.layout.restHeightM) < limits.FLAT_TOLERANCE_M;
  }

  _isAt(stone, place) {
    const toleranceMm = place === moves.TRAY ? 0 : rules.SUCCESS_TOLERANCE_MM;
    return 1e3 * distanceM(this._xy(stone), place) <= toleranceMm;
  }

  _isAtPlace(stone) {
    return this._isFlat(stone) && this._fitting(stone).length > 0;
  }

  /** The plans that have a move for this stone to where it lies, with that move made. */
  _fitting(stone) {
    return this._plans.flatMap(({ plan, made }) => {
      for (const [number, move] of openMoves(plan, made)) {
        if (!stonesLeft(move, made).includes(stone)) continue;
        const [place] = this._placesUnder(stone, move, made);
        if (place !== undefined) return [{ plan, made: new Map(made).set(number, { stone, place }) }];
      }
      return [];
    });
  }

  _placesUnder(stone, move, made) {
    return placesLeft(move, made).filter((place) => this._isAt(stone, place));
  }

  /** Judge a stone that has been put down; return true if the episode has ended. */
  _judgePlacement(stone) {
    this._stone = stone;
    const isPlace = this._places().some((place) => keyOf(place) === keyOf(this.nearestIntersection));
    if (this._wasLifted[stone] && this._mustBeSlid(stone)) this.failure = "lifted";
    else if (this._isAtPlace(stone)) return this._takeMove(stone);
    else if (this._wasDropped(stone)) this.failure = "dropped";
    else this.failure = isPlace ? "imprecise" : "wrong_intersection";
    return true;
  }

  /** Add a move to those made; return true if it was the last. */
  _takeMove(stone) {
    const fitting = this._fitting(stone);
    this._isComplete = fitting.some(({ plan, made }) => made.size === plan.length);
    if (this._isComplete) {
      this.stage = "placed";
      this.isSuccess = this.collateralMm <= rules.COLLATERAL_TOLERANCE_MM;
      this.failure = this.isSuccess ? null : "disturbed_others";
      return true;
    }
    this._plans = fitting;
    this._wasLifted[stone] = false;
    this._leftXyz[stone] = [...this._now.stoneXyz[stone]];
    this._restSteps[stone] = 0;
    this._movable = this._findMovable();
    if (!this._movable.has(this._stone)) this._stone = Math.min(...this._movable);
    return false;
  }

  _mustBeSlid(stone) {
    return [...this._openMoves()]
      .filter(({ move, made }) => stonesLeft(move, made).includes(stone))
      .every(({ move }) => move.is_slid);
  }

  _wasDropped(stone) {
    const highestM = this.layout.restHeightM + rules.DROP_HEIGHT_M;
    return isOffBoard(this._xy(stone)) || this._lastTouchedZ[stone] > highestM;
  }
}

/** Whether a point is too far from every intersection for a stone to be placed. */
export function isOffBoard(xy) {
  return norm(minus(xy, intersectionXy(nearestIntersection(xy)))) > rules.OFF_BOARD_M;
}
