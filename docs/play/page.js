// The page: its controls, the loop that simulates and draws, and its messages.
import { nearestIntersection } from "./board.js";
import { DEFAULT_CHOICE, choiceOf, commandsOf, hashOf, isPerturbed, notesOf } from "./choice.js";
import { POLICY, SEEDS, SUITES, board, episode as rules, perturbations } from "./constants.js";
import { Drawer, pointAt } from "./draw.js";
import { Run, drawEpisode } from "./episode.js";
import { readBytes, readJson, readText } from "./files.js";
import { isOffBoard } from "./judge.js";
import { BoardMap } from "./map.js";
import { loadPolicy } from "./policy.js";
import { RunView } from "./run_view.js";
import { Scene } from "./scene.js";
import { placementOf, placementTask, understand } from "./sentence.js";

const { AXES, MAX_LEVEL } = perturbations;
const PICTURE_PX = 384;
const FRAME_MS = 24; // of simulation in one frame, at most
const byId = (id) => document.getElementById(id);

class Page {
  constructor(mujoco, files) {
    this._mujoco = mujoco;
    this._files = files;
    this._suites = {};
    this._scenes = [new Scene(mujoco, files)];
    this._drawer = new Drawer(mujoco, this._scenes[0].model, PICTURE_PX);
    this._map = new BoardMap(byId("map"), (intersection) => this._tell(() => this._choosePlace(intersection)));
    this._views = [];
    this._isPlaying = false;
    this._fillControls();
    this._listen();
  }

  /** The first picture. */
  async start() {
    this._choice = { ...DEFAULT_CHOICE };
    await this._tell(async () => {
      try {
        await this._show(await this._linked());
      } catch (error) {
        await this._show(DEFAULT_CHOICE);
        throw error;
      }
    });
    for (const id of ["play", "restart"]) byId(id).disabled = false;
  }

  _fillControls() {
    const fill = (id, options) =>
      byId(id).replaceChildren(...options.map(([value, text]) => new Option(text, value)));
    fill("suite", SUITES.map((name) => [name, name]));
    fill("seed", SEEDS.map((seed, place) => [place, seed]));
    fill("policy", [["", "the scripted expert"], [POLICY, `the policy bomb:${POLICY}`]]);
    byId("axes").replaceChildren(...Object.keys(AXES).map(newSlider));
  }

  _listen() {
    const change = (id, made) =>
      byId(id).addEventListener("input", () => this._tell(() => this._show({ ...this._choice, ...made(byId(id).value) })));
    change("suite", (suite) => ({ suite, task: null, words: null }));
    change("seed", (place) => ({ seedPlace: Number(place) }));
    change("task", (task) => ({ task: task === "" ? null : Number(task), words: null }));
    change("policy", (policy) => ({ policy: policy || null }));
    for (const axis of Object.keys(AXES)) {
      change(`axis-${axis}`, (level) => ({ levels: levelsOf({ ...this._choice.levels, [axis]: Number(level) }) }));
    }
    byId("unperturbed").addEventListener("click", () => this._tell(() => this._show({ ...this._choice, levels: {} })));
    byId("sentence-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this._tell(() => this._obey(byId("sentence").value));
    });
    byId("play").addEventListener("click", () => (this._isPlaying ? this._pause() : this._play()));
    byId("restart").addEventListener("click", () => this._tell(() => this._show(this._choice)));
    addEventListener("hashchange", () => this._tell(async () => this._show(await this._linked())));
    for (const button of document.querySelectorAll("[data-copy]")) {
      button.addEventListener("click", () => copy(button, byId(button.dataset.copy)));
    }
  }

  /** Do something; show the message of what goes wrong. */
  async _tell(action) {
    say("");
    try {
      await action();
    } catch (error) {
      say(error.message);
    }
  }

  async _record(suite) {
    this._suites[suite] ??= await readJson(`${suite}.json`);
    return this._suites[suite];
  }

  /** The choice of the page's address. */
  async _linked() {
    const choice = choiceOf(location.hash);
    if (choice.words === null) return choice;
    const { suite, task } = understand(choice.words, shownOf(choice, await this._record(choice.suite)));
    if (suite === choice.suite && task === choice.task) return choice;
    throw new Error("The link's words and its task ask for different things.");
  }

  /** Show the start of an episode. */
  async _show(choice) {
    this._pause();
    const ticket = (this._ticket = (this._ticket ?? 0) + 1);
    const record = await this._record(choice.suite);
    const numTasks = record.episodes.length;
    if (choice.task !== null && choice.task >= numTasks) {
      throw new Error(`Suite ${choice.suite} has tasks 0 to ${numTasks - 1}; there is no task ${choice.task}.`);
    }
    if ("dynamics" in choice.levels) this._noise ??= await readJson("noise.json");
    const act = choice.policy === null ? undefined : await this._policy();
    if (ticket !== this._ticket) return; // the visitor has chosen something else meanwhile
    this._choice = choice;
    const { seedPlace, levels } = choice;
    const shown = isPerturbed(levels) ? [levels, {}] : [{}];
    while (this._scenes.length < shown.length) this._scenes.push(new Scene(this._mujoco, this._files));
    while (this._views.length < shown.length) this._views.push(this._newView());
    byId("runs").classList.toggle("compare", shown.length > 1);
    byId("runs").replaceChildren(...shown.map((_, i) => this._views[i].element));
    this._runs = shown.map((each, i) => {
      const episode = drawEpisode(record, taskOf(choice, record), seedPlace, each);
      const noise = this._noise?.[SEEDS[seedPlace]];
      const run = new Run(this._scenes[i], record, episode, { words: choice.words, noise, act });
      const isClean = i > 0;
      const words = Object.entries(each).map(([axis, level]) => `${spaced(axis)} ${level}`);
      this._views[i].show(run, isClean ? "Same seed, clean" : [`Seed ${SEEDS[seedPlace]}`, ...words].join(", "));
      return run;
    });
    this._update(record);
    this._draw();
  }

  /** How the policy acts; it is fetched when it is first asked for. */
  async _policy() {
    if (this._act !== undefined) return this._act;
    const play = byId("play");
    play.disabled = true;
    play.textContent = "Loading the policy: 7 MB …";
    try {
      const policy = await loadPolicy(this._mujoco, this._scenes[0].model);
      this._act = (run) => policy.act(run);
    } finally {
      play.disabled = false;
      this._pause();
    }
    return this._act;
  }

  _newView() {
    const view = new RunView(byId("run"), this._drawer);
    view.workspace.addEventListener("click", (event) => this._tell(() => this._choosePoint(view, event)));
    return view;
  }

  /** Write the choice into controls, link and commands. */
  _update(record) {
    const { suite, seedPlace, task, words, levels, policy } = this._choice;
    const isPlace = suite === "place";
    const label = (number) => {
      if (!isPlace) return record.episodes[number][seedPlace].instructions[0];
      const { color, target } = placementOf(number);
      return `${color} to row ${target[0]}, column ${target[1]}`;
    };
    const tasks = record.episodes.map((_, number) => new Option(`${number}: ${label(number)}`, number));
    byId("task").replaceChildren(new Option(`drawn by the seed: ${record.drawn[seedPlace]}`, ""), ...tasks);
    byId("suite").value = suite;
    byId("seed").value = seedPlace;
    byId("task").value = task ?? "";
    byId("policy").value = policy ?? "";
    for (const axis of Object.keys(AXES)) {
      byId(`axis-${axis}`).value = levels[axis] ?? 0;
      byId(`level-${axis}`).textContent = levels[axis] ?? 0;
    }
    byId("unperturbed").disabled = !isPerturbed(levels);
    const notes = Object.entries(levels).map(([axis, level]) => notesOf(axis, level));
    byId("axis-notes").replaceChildren(...notes.map(newNote));
    byId("map-note").textContent = isPlace
      ? "Click, or use the arrow keys and Enter. Stones in the way are drawn anew."
      : "In this suite, choose a task; suite place lets you choose an intersection.";
    this._map.allow(isPlace, this._runs[0].episode.target);
    for (const view of this._views) view.workspace.classList.toggle("clickable", isPlace);
    const hash = hashOf(this._choice);
    if (location.hash !== hash) history.replaceState(null, "", hash);
    byId("link").value = location.href;
    byId("words-note").hidden = words === null;
    const commands = commandsOf(this._choice);
    byId("eval-command").value = commands.eval;
    byId("view-command").value = commands.view;
  }

  async _obey(sentence) {
    const record = await this._record(this._choice.suite);
    await this._showAndPlay(understand(sentence, shownOf(this._choice, record)));
  }

  async _choosePlace(intersection) {
    const record = await this._record(this._choice.suite);
    await this._showAndPlay({ task: placementTask(colorOf(this._choice, record), intersection), words: null });
  }

  async _choosePoint(view, event) {
    if (this._choice.suite !== "place") return;
    const { width, height } = view.workspace.getBoundingClientRect();
    const point = [(2 * event.offsetX) / width - 1, 1 - (2 * event.offsetY) / height];
    const xy = pointAt(view.scene, "workspace", point, board.BOARD.thickness_m);
    if (isOffBoard(xy)) throw new Error("That point is off the board: click near an intersection.");
    await this._choosePlace(nearestIntersection(xy));
  }

  async _showAndPlay(change) {
    await this._show({ ...this._choice, ...change });
    if (matchMedia("(max-width: 60rem)").matches) byId("stage").scrollIntoView();
    this._play();
  }

  _play() {
    if (this._runs.every((run) => run.hasEnded)) {
      this._tell(() => this._showAndPlay({}));
      return;
    }
    this._isPlaying = true;
    this._last = performance.now();
    this._due = 0;
    byId("play").textContent = "Pause";
    requestAnimationFrame((now) => this._frame(now));
  }

  _pause() {
    this._isPlaying = false;
    const hasEnded = this._runs?.every((run) => run.hasEnded);
    byId("play").textContent = hasEnded ? "Play again" : "Play";
  }

  _frame(now) {
    if (!this._isPlaying) return;
    try {
      this._advance(now);
    } catch (error) {
      this._pause();
      say(`The episode cannot go on. ${error.message}`);
    }
  }

  /** Simulate what is due since the last frame, as far as there is time, and draw. */
  _advance(now) {
    const speed = Number(byId("speed").value);
    this._due += (Math.max(0, now - this._last) / 1000) * rules.PHYSICS_HZ * speed;
    this._last = now;
    const end = performance.now() + FRAME_MS;
    let isRunning = true;
    const isWaiting = () => this._runs.some((run) => run.isWaiting);
    while (isRunning && !isWaiting() && this._due >= 1 && performance.now() < end) {
      isRunning = this._runs.map((run) => run.advance()).some(Boolean);
      for (const [i] of this._runs.entries()) this._views[i].follow();
      this._due -= 1;
    }
    this._due = Math.min(this._due, 1); // what a slow computer cannot simulate in time is late
    this._draw();
    if (isRunning) requestAnimationFrame((next) => this._frame(next));
    else this._pause();
  }

  _draw() {
    if (this._drawer.isLost) {
      this._pause();
      say("The browser has taken the page's graphics away, perhaps for lack of memory. Reload the page.");
      return;
    }
    for (const [i] of this._runs.entries()) this._views[i].draw();
    this._map.draw(...this._views[0].fromAbove());
  }
}

function taskOf(choice, record) {
  return choice.task ?? record.drawn[choice.seedPlace];
}

/** The colour of the stone where a visitor names only its place. */
function colorOf(choice, record) {
  return choice.suite === "place" ? placementOf(taskOf(choice, record)).color : board.COLORS[0];
}

/** What `understand` has to know of what is shown. */
function shownOf(choice, record) {
  return { name: choice.suite, record, seedPlace: choice.seedPlace, color: colorOf(choice, record) };
}

/** Those of {axis: level} that are on, in the order of the axes. */
function levelsOf(levels) {
  return Object.fromEntries(Object.keys(AXES).filter((axis) => levels[axis] > 0).map((axis) => [axis, levels[axis]]));
}

function spaced(name) {
  return name.replace("_", " ");
}

/** A slider for the level of an axis. */
function newSlider(axis) {
  const slider = byId("axis").content.firstElementChild.cloneNode(true);
  const [label, output, range] = ["label", "output", "input"].map((tag) => slider.querySelector(tag));
  label.prepend(`${spaced(axis)} `);
  label.htmlFor = range.id = `axis-${axis}`;
  output.id = `level-${axis}`;
  range.max = MAX_LEVEL;
  return slider;
}

/** What an axis changes: a line, and a line for each size. */
function newNote([summary, ...sizes]) {
  const list = document.createElement("ul");
  list.replaceChildren(...sizes.map((size) => Object.assign(document.createElement("li"), { textContent: size })));
  const note = document.createElement("li");
  note.replaceChildren(summary, list);
  return note;
}

function say(text) {
  byId("message").hidden = text === "";
  byId("message").textContent = text;
}

async function copy(button, field) {
  field.select();
  const text = button.textContent;
  try {
    await navigator.clipboard.writeText(field.value);
    button.textContent = "Copied";
  } catch {
    button.textContent = "Press Ctrl+C"; // the text is selected
  }
  setTimeout(() => (button.textContent = text), 2000);
}

async function main() {
  if (typeof WebAssembly !== "object") throw new Error("This browser has no WebAssembly, which MuJoCo needs here.");
  const [{ default: loadMujoco }, wasmBinary, xml, exact, textures] = await Promise.all([
    import("./mujoco.js"),
    readBytes("mujoco.wasm"),
    readText("model.xml"),
    readJson("exact.json"),
    readBytes("textures.bin"),
  ]);
  const page = new Page(await loadMujoco({ wasmBinary }), { xml, exact, textures });
  await page.start();
}

main().catch((error) => {
  byId("loading")?.remove();
  say(`The page could not start. ${error.message}`);
});
