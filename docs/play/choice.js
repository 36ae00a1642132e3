// What is shown: suite, seed, task, the visitor's words, axes, levels and who acts, as the page's address and as flags
// of a command.
import { POLICY, SEEDS, SUITES, perturbations } from "./constants.js";

const { AXES, MAX_LEVEL } = perturbations;
export const DEFAULT_CHOICE = { suite: "place", seedPlace: 0, task: null, words: null, levels: {}, policy: null };
const NAMES = ["suite", "seed", "task", "words", "perturbations", "policy"];

/**
 * A choice as the part of an address after "#"; task null: the seed's; words null: the episode's own instruction;
 * policy null: the expert acts.
 */
export function hashOf({ suite, seedPlace, task, words, levels, policy }) {
  const parts = [`suite=${suite}`, `seed=${SEEDS[seedPlace]}`];
  if (task !== null) parts.push(`task=${task}`);
  if (words !== null) parts.push(`words=${encodeURIComponent(words)}`);
  if (isPerturbed(levels)) parts.push(`perturbations=${conditionOf(levels)}`);
  if (policy !== null) parts.push(`policy=${policy}`);
  return `#${parts.join("&")}`;
}

/** The choice of an address; throws an Error with a message for the visitor. */
export function choiceOf(hash) {
  const asked = Object.fromEntries(new URLSearchParams(hash.replace(/^#/, "")));
  const unknown = Object.keys(asked).filter((name) => !NAMES.includes(name));
  if (unknown.length > 0) throw new Error(`The link asks for “${unknown[0].slice(0, 40)}”, which this page does not have.`);
  const oneOf = (name, names, word = asked[name]) => {
    if (names.includes(word)) return word;
    throw new Error(`The link asks for ${name} “${word.slice(0, 40)}”; there are ${names.join(", ")}.`);
  };
  const number = (name, low, high, word = asked[name]) => {
    if (/^\d+$/.test(word) && word >= low && word <= high) return Number(word);
    throw new Error(`The link asks for ${name} “${word.slice(0, 40)}”; it goes from ${low} to ${high}.`);
  };
  const levels = (condition) =>
    condition.split(/[ +]/).map((part) => {
      const [axis, level = ""] = part.split(":");
      return [oneOf("perturbation", Object.keys(AXES), axis), number(`level of ${axis}`, 1, MAX_LEVEL, level)];
    });
  const choice = { ...DEFAULT_CHOICE };
  if ("suite" in asked) choice.suite = oneOf("suite", SUITES);
  if ("seed" in asked) choice.seedPlace = SEEDS.indexOf(number("seed", SEEDS[0], SEEDS.at(-1)));
  if ("task" in asked) choice.task = number("task", 0, Infinity);
  if ("words" in asked) choice.words = asked.words;
  if ("perturbations" in asked) choice.levels = Object.fromEntries(levels(asked.perturbations));
  if ("policy" in asked) choice.policy = oneOf("policy", [POLICY]);
  return choice;
}

export function isPerturbed(levels) {
  return Object.keys(levels).length > 0;
}

/** {axis: level} as --env.perturbations has it. */
function conditionOf(levels) {
  return Object.entries(levels).map(([axis, level]) => `${axis}:${level}`).join("+");
}

/** The commands that repeat a choice: an evaluation, and a video. */
export function commandsOf({ suite, seedPlace, task, levels, policy }) {
  const seed = `--seed=${SEEDS[seedPlace]}`;
  const flags = [`--env.task=${suite}`];
  if (task !== null) flags.push(`--env.task_ids='[${task}]'`);
  const condition = isPerturbed(levels) ? conditionOf(levels) : null;
  const checkpoint = `--policy.path=bomb:${policy} --policy.device=cpu`;
  return {
    eval: [
      `lerobot-eval ${policy === null ? "--policy.type=bomb_expert" : checkpoint} --env.type=bomb`,
      ...flags,
      ...(condition ? [`--env.perturbations='["${condition}"]'`] : []),
      `${seed} --eval.n_episodes=1 --eval.batch_size=1`,
    ].join(" "),
    view: [
      "lerobot-bomb view",
      ...(policy === null ? [] : [checkpoint]),
      seed,
      ...flags,
      ...(condition ? [`--env.perturbations=${condition}`] : []),
    ].join(" "),
  };
}

/** What an axis changes at a level, line by line. */
export function notesOf(axis, level) {
  const { summary, magnitudes } = AXES[axis];
  const size = (value, unit) => {
    if (unit === "share") return `${Math.round(100 * value)} %`;
    return unit === "1 = yes" ? (value ? "yes:" : "no:") : `${value} ${unit}`;
  };
  const sizes = magnitudes.map(({ unit, levels, what }) => `${size(levels[level - 1], unit)} ${what}`);
  return [`${summary[0].toUpperCase()}${summary.slice(1)}:`, ...sizes];
}
