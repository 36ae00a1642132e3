// Moves that an episode asks for, and the expert's goals: a port of bomb/move.py and bomb/goals.py.
// A plan is a list of moves; `made` is a Map {number of a move: {stone, place}}.
import { BOARD, intersectionXy, keyOf, minus, norm } from "./board.js";
import { commands, move as moves } from "./constants.js";

/** Moves that may be made next, with their numbers; sees what is added to `made` meanwhile. */
export function* openMoves(plan, made) {
  for (const [number, move] of plan.entries()) {
    if (!made.has(number) && move.after.every((each) => made.has(each))) yield [number, move];
  }
}

export function stonesLeft(move, made) {
  if (move.stones.length === 1) return move.stones;
  const taken = new Set([...made.values()].map((each) => each.stone));
  return move.stones.filter((stone) => !taken.has(stone));
}

export function placesLeft(move, made) {
  const taken = new Set([...made.values()].map((each) => keyOf(each.place)));
  taken.delete(moves.TRAY);
  return move.places.filter((place) => !taken.has(keyOf(place)));
}

/** Spots where the expert puts stones, in its order: the tray first. Places are sorted already. */
function spotsOf(places) {
  if (places.includes(moves.TRAY)) return commands.TRAY_XY_M.map((xy) => ({ place: moves.TRAY, xy }));
  return places.map((place) => ({ place, xy: intersectionXy(place) }));
}

/**
 * The goals of a course {plan, made, lying, carried}: those whose stones lie in place, that of the carried
 * stone, the others. A goal is {number, xyz, stone, isSlid}.
 */
export function courseGoals({ plan, made, lying, carried }, layout, stoneXyz) {
  const goals = [];
  const stoneXy = stoneXyz.map(([x, y]) => [x, y]);
  const add = (number, stone, xy) =>
    goals.push({ number, xyz: [...xy, layout.restHeightM], stone, isSlid: plan[number].is_slid });
  for (const [number, { stone, place }] of lying) {
    const spots = spotsOf([place]).map(({ xy }) => xy);
    const away = spots.map((xy) => norm(minus(xy, stoneXy[stone])));
    const nearest = away.indexOf(Math.min(...away));
    const isNear = away[nearest] <= layout.stoneRadiusM;
    if (isNear || !made.has(number)) {
      add(number, stone, isNear || place !== moves.TRAY ? spots[nearest] : stoneXy[stone]);
    }
  }
  const planned = new Map(lying);
  for (const number of new Set([...(carried ? [carried.number] : []), ...plan.keys()])) {
    if (planned.has(number)) continue;
    const move = plan[number];
    const isCarried = carried !== null && carried.number === number;
    const stone = isCarried ? carried.stone : Math.min(...stonesLeft(move, planned));
    const others = stoneXy.filter((_, i) => i < layout.numStones && i !== stone);
    const spots = spotsOf(placesLeft(move, planned));
    const isFree = ({ xy }) => others.every((other) => norm(minus(other, xy)) >= 2 * layout.stoneRadiusM);
    const { place, xy } = spots.find(isFree) ?? spots[0];
    planned.set(number, { stone, place });
    stoneXy[stone] = xy;
    add(number, stone, xy);
  }
  return goals;
}

/** Layout of an episode's stones at the start. */
export function layoutOf(episode) {
  const [stoneRadiusM, stoneHeightM] = episode.stone_size;
  return {
    numStones: episode.stones.length,
    stoneRadiusM,
    stoneHeightM,
    restHeightM: BOARD.thickness_m + stoneHeightM / 2,
  };
}
