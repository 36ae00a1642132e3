// One episode on the page: both cameras, the instruction, how it stands.
import { minus, norm } from "./board.js";
import { board, episode as rules, observation } from "./constants.js";

const MIN_PATH_M = 0.001; // between two points of a path

export class RunView {
  /** @param template its HTML; @param drawer what draws cameras */
  constructor(template, drawer) {
    this.element = template.content.firstElementChild.cloneNode(true);
    this._drawer = drawer;
    this._canvases = [...this.element.querySelectorAll("canvas")];
  }

  get workspace() {
    return this._canvases[0];
  }

  get scene() {
    return this._run.scene;
  }

  /** Show a run that is about to begin. */
  show(run, title) {
    this._run = run;
    this._gripperPath = [];
    this._stonePaths = new Map(); // of stones that have moved
    this._part("h2").textContent = title;
    observation.CAMERAS.forEach((camera, i) =>
      this._canvases[i].setAttribute("aria-label", `${title}: ${camera} camera`),
    );
  }

  _part(selector) {
    return this.element.querySelector(selector);
  }

  draw() {
    const run = this._run;
    observation.CAMERAS.forEach((camera, i) =>
      this._drawer.draw(run.scene, camera, this._canvases[i], run.episode.sensor),
    );
    this.follow();
    setText(this._part(".instruction"), run.instruction);
    const step = run.steps === 0 ? `at most ${run.maxSteps} steps` : `step ${run.steps} of ${run.maxSteps}`;
    const { judge } = run;
    const moves = judge.numMoves > 1 ? ` · ${judge.numMade} of ${judge.numMoves} moves` : "";
    setText(this._part(".progress"), `${step} · ${judge.stage}${moves}`);
    const status = this._part(".status");
    setText(status, run.hasEnded ? outcomeOf(run) : "");
    status.className = `status ${judge.isSuccess ? "success" : "failure"}`;
  }

  /** Add to the paths; to be called after each substep. */
  follow() {
    const { gripperXyz, stoneXyz } = this._run.scene.positions();
    extend(this._gripperPath, gripperXyz.slice(0, 2));
    this._run.episode.stones.forEach(([x, y], i) => {
      const path = this._stonePaths.get(i) ?? [[x, y]];
      if (extend(path, stoneXyz[i].slice(0, 2))) this._stonePaths.set(i, path);
    });
  }

  /** Stones and paths, for the map. */
  fromAbove() {
    const { scene, judge, episode } = this._run;
    const { stoneXyz } = scene.positions();
    const stones = episode.stones.map(([, , isWhite], i) => ({
      xy: stoneXyz[i].slice(0, 2),
      isWhite: board.COLORS[isWhite] === "white",
      radiusM: judge.layout.stoneRadiusM,
    }));
    const moved = [...this._stonePaths.values()].map((points) => ({ points, kind: "moved" }));
    return [stones, [{ points: this._gripperPath, kind: "gripper" }, ...moved]];
  }
}

/** Add a point to a path if it is not where the path ends; return true if it was added. */
function extend(path, xy) {
  const isNew = path.length === 0 || norm(minus(xy, path.at(-1))) > MIN_PATH_M;
  if (isNew) path.push(xy);
  return isNew;
}

/** How an episode ended. */
function outcomeOf({ judge, steps }) {
  if (!judge.isSuccess) return `Failed: ${judge.failure}, that is, ${rules.FAILURES[judge.failure]}.`;
  const error = `${judge.placementErrorMm.toFixed(1)} mm from its place`;
  return `Success after ${steps} steps${judge.numMoves > 1 ? "" : `, ${error}`}.`;
}

/** Change a text only if it is another, so that screen readers hear it once. */
function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
