// What a typed sentence asks for. The page knows the sentences of its suites, not language.
import { BOARD, isOnBoard } from "./board.js";
import { board, place } from "./constants.js";

const MAX_LENGTH = 300;
const TEMPLATES = [...place.TEMPLATES, ...place.FORMS.flat()].map(compile);
// of a sentence in free words; any other word could change what "row" and "column" mean
const PLAIN_WORDS = new Set(
  `a an and at board col column go in intersection it me move now of on one onto piece place please position
  put row set stone the this to`.split(/\s+/).concat(board.COLORS),
);

/** A template as a regular expression and the names of its groups. */
function compile(template) {
  const names = [];
  const source = normal(template)
    .split(/(\{\w+\})/)
    .map((part) => {
      const name = /^\{(\w+)\}$/.exec(part)?.[1];
      if (name === undefined) return part.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");
      names.push(name);
      if (name === "color") return `(${board.COLORS.join("|")})`;
      return name.endsWith("letter") ? "([a-z])" : "(-?\\d+)";
    })
    .join("");
  return { expression: new RegExp(`^${source}$`), names };
}

/** A sentence without what does not matter: case, spaces, the full stop. */
function normal(text) {
  return text.toLowerCase().replace(/\s+/g, " ").trim().replace(/[.!]+$/, "");
}

/** The row and column that a template's coordinates mean. */
function intersectionOf(values) {
  const last = BOARD.num_lines - 1;
  const number = (name, meaning) => (name in values ? meaning(Number(values[name])) : undefined);
  const row =
    number("row", (n) => n) ??
    number("row_from_1", (n) => n - 1) ??
    number("near_row", (n) => last - n) ??
    number("near_row_from_1", (n) => last - (n - 1));
  const column =
    number("column", (n) => n) ??
    number("column_from_1", (n) => n - 1) ??
    values.letter.charCodeAt(0) - "a".charCodeAt(0);
  return [row, column];
}

/** Colour and intersection of a sentence of suite `place`; null if it is none. */
function asPlacement(text) {
  for (const { expression, names } of TEMPLATES) {
    const match = expression.exec(text);
    if (match === null) continue;
    const values = Object.fromEntries(names.map((name, i) => [name, match[i + 1]]));
    return { color: values.color, target: intersectionOf(values) };
  }
  return asPlainPlacement(text);
}

/** The same for other words around "row 1, column 2" or "(1, 2)", if nothing else could be meant. */
function asPlainPlacement(text) {
  const colors = board.COLORS.filter((color) => new RegExp(`\\b${color}\\b`).test(text));
  const named = [/\brow (-?\d+)/, /\bcol(?:umn)? (-?\d+)/].map((each) => each.exec(text)?.[1]);
  const pair = /\(?(-?\d+) ?, ?(-?\d+)\)?/.exec(text)?.slice(1);
  const target = named.every((each) => each !== undefined) ? named : pair;
  const isPlain = (text.match(/[^\s\d.,()-]+/g) ?? []).every((word) => PLAIN_WORDS.has(word));
  const isClear = text.match(/-?\d+/g)?.length === 2 && colors.length < 2 && isPlain;
  return target && isClear ? { color: colors[0], target: target.map(Number) } : null;
}

/**
 * What a sentence asks for: {suite, task, seedPlace, words}; words null where they are the episode's own.
 *
 * @param shown {name, record, seedPlace, color}: the suite shown, the seed's place, the colour if none is said
 * @throws Error with a message for the visitor
 */
export function understand(sentence, shown) {
  const text = normal(sentence);
  if (text === "") throw new Error("Type a sentence first.");
  if (sentence.length > MAX_LENGTH) {
    throw new Error(`That sentence has ${sentence.length.toLocaleString("en")} characters; ${MAX_LENGTH} are the limit.`);
  }
  const known = shown.name === "place" ? null : findInstruction(text, shown);
  if (known !== null) return { suite: shown.name, ...known, words: null };
  const placement = asPlacement(text);
  if (placement === null) {
    throw new Error(
      `This page does not understand “${shortened(sentence)}”. It knows sentences such as ` +
        "“Place a white stone on the Go board at row 1, column 2.”, and those listed under Task.",
    );
  }
  const { color = shown.color, target } = placement;
  return { suite: "place", task: placementTask(color, target), seedPlace: shown.seedPlace, words: sentence.trim() };
}

/** The task of suite `place` with this colour and target. */
export function placementTask(color, [row, column]) {
  if (!isOnBoard(row, column)) {
    throw new Error(
      `Row ${row}, column ${column} is off the board: rows and columns go from 0 to ${BOARD.num_lines - 1}.`,
    );
  }
  return BOARD.num_lines ** 2 * board.COLORS.indexOf(color) + BOARD.num_lines * row + column;
}

/** Colour and target of a task of suite `place`. */
export function placementOf(task) {
  const point = task % BOARD.num_lines ** 2;
  return {
    color: board.COLORS[Math.floor(task / BOARD.num_lines ** 2)],
    target: [Math.floor(point / BOARD.num_lines), point % BOARD.num_lines],
  };
}

/** An episode of the suite shown with this instruction, of the seed shown if it has one. */
function findInstruction(text, { record, seedPlace }) {
  const places = [...Array(record.drawn.length).keys()].sort((a, b) => (b === seedPlace) - (a === seedPlace));
  for (const each of places) {
    const task = record.episodes.findIndex((seeds) => normal(seeds[each].instructions[0]) === text);
    if (task >= 0) return { task, seedPlace: each };
  }
  return null;
}

function shortened(text) {
  const line = text.replace(/\s+/g, " ").trim();
  return line.length > 60 ? `${line.slice(0, 60)}…` : line;
}
