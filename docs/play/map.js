// The board from above: stones, the paths of gripper and stone, and a button on each intersection.
import { BOARD, intersectionXy } from "./board.js";
import { board } from "./constants.js";

const EDGE_M = 0.012; // around board and tray
const LEFT_M = -BOARD.half_size_m - EDGE_M;
const RIGHT_M = board.TRAY_CENTER_XY[0] + board.TRAY_HALF_SIZE_XY[0] + EDGE_M;
const HALF_HEIGHT_M = BOARD.half_size_m + EDGE_M;
const [WIDTH, HEIGHT] = [1000 * (RIGHT_M - LEFT_M), 2000 * HALF_HEIGHT_M]; // millimetres, as the drawing's units
const LINES = [...Array(BOARD.num_lines).keys()];

const toMap = ([x, y]) => [1000 * (x - LEFT_M), 1000 * (HALF_HEIGHT_M - y)];
const millimetres = (metres) => 1000 * metres;

function element(name, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function rectangle([x, y], [halfWidth, halfHeight], kind) {
  const [left, top] = toMap([x - halfWidth, y + halfHeight]);
  const size = { width: millimetres(2 * halfWidth), height: millimetres(2 * halfHeight) };
  return element("rect", { x: left, y: top, ...size, class: kind });
}

export class BoardMap {
  /**
   * @param holder where the map is put
   * @param choose called with [row, column]
   */
  constructor(holder, choose) {
    this._svg = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, "aria-hidden": "true" });
    this._svg.append(...this._ground());
    this._shapes = element("g", {});
    this._svg.append(this._shapes);
    this._buttons = LINES.flatMap((row) => LINES.map((column) => this._button([row, column], choose)));
    holder.replaceChildren(this._svg, ...this._buttons);
    this._focus(0);
  }

  _ground() {
    const half = BOARD.half_size_m;
    const end = intersectionXy([0, BOARD.num_lines - 1])[0];
    const lines = LINES.flatMap((line) => {
      const place = intersectionXy([0, line])[0];
      return [[[place, -end], [place, end]], [[-end, place], [end, place]]];
    });
    return [
      rectangle(board.TRAY_CENTER_XY, board.TRAY_HALF_SIZE_XY, "tray"),
      rectangle([0, 0], [half, half], "board"),
      ...lines.map((points) => element("polyline", { points: points.map(toMap).join(" "), class: "line" })),
    ];
  }

  _button(intersection, choose) {
    const button = document.createElement("button");
    const [x, y] = toMap(intersectionXy(intersection));
    button.type = "button";
    button.style.left = `${(100 * x) / WIDTH}%`;
    button.style.top = `${(100 * y) / HEIGHT}%`;
    button.style.width = `${(100 * millimetres(BOARD.pitch_m)) / WIDTH}%`;
    button.setAttribute("aria-label", `row ${intersection[0]}, column ${intersection[1]}`);
    button.title = `row ${intersection[0]}, column ${intersection[1]}`;
    button.addEventListener("click", () => choose(intersection));
    button.addEventListener("keydown", (event) => this._walk(event, intersection));
    return button;
  }

  /** Arrow keys go from intersection to intersection; the tab key enters and leaves the board. */
  _walk(event, [row, column]) {
    const steps = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
    const step = steps[event.key];
    if (step === undefined) return;
    event.preventDefault();
    const next = [row + step[0], column + step[1]];
    if (next.every((line) => LINES.includes(line))) this._focus(next[0] * LINES.length + next[1], true);
  }

  _focus(number, isNow = false) {
    this._buttons.forEach((button, i) => (button.tabIndex = i === number ? 0 : -1));
    if (isNow) this._buttons[number].focus();
  }

  /** Let intersections be chosen, or not; mark the target, if there is one. */
  allow(isAllowed, target) {
    for (const button of this._buttons) button.disabled = !isAllowed;
    const number = target ? target[0] * LINES.length + target[1] : -1;
    this._buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(i === number)));
    if (target) this._focus(number);
  }

  /** Draw stones {xy, isWhite, radiusM}, and paths {points, kind}. */
  draw(stones, paths) {
    const circles = stones.map(({ xy, isWhite, radiusM }) => {
      const [cx, cy] = toMap(xy);
      return element("circle", { cx, cy, r: millimetres(radiusM), class: isWhite ? "white stone" : "black stone" });
    });
    const lines = paths.map(({ points, kind }) =>
      element("polyline", { points: points.map(toMap).join(" "), class: `path ${kind}` }),
    );
    this._shapes.replaceChildren(...circles, ...lines);
  }
}
