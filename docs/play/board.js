// The board and its intersections. Metres, world frame: x right, y to the far row, z up.
import { board, move } from "./constants.js";

export const BOARD = board.BOARD;
const MIDDLE = (BOARD.num_lines - 1) / 2;

/** Length of a vector. */
export function norm(values) {
  return Math.sqrt(values.reduce((sum, value) => sum + value * value, 0));
}

/** Difference of two vectors. */
export function minus(a, b) {
  return a.map((value, i) => value - b[i]);
}

export function clip(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

export function isOnBoard(row, column) {
  const isLine = (line) => Number.isInteger(line) && line >= 0 && line < BOARD.num_lines;
  return isLine(row) && isLine(column);
}

export function intersectionXy([row, column]) {
  return [(column - MIDDLE) * BOARD.pitch_m, (MIDDLE - row) * BOARD.pitch_m];
}

export function nearestIntersection([x, y]) {
  const line = (value) => clip(Math.round(value), 0, BOARD.num_lines - 1);
  return [line(MIDDLE - y / BOARD.pitch_m), line(x / BOARD.pitch_m + MIDDLE)];
}

/** Metres from a point to an intersection, or to the tray: 0 anywhere in it. */
export function distanceM(xy, place) {
  if (place !== move.TRAY) return norm(minus(xy, intersectionXy(place)));
  const outside = xy.map((value, i) => Math.abs(value - board.TRAY_CENTER_XY[i]) - board.TRAY_HALF_SIZE_XY[i]);
  return norm(outside.map((value) => Math.max(value, 0)));
}

/** A place as text, so that equal places are equal. */
export function keyOf(place) {
  return String(place);
}
