// Joins the page's parts: the connection to the server, what is known, and the panels.

import { Lanes } from "./charts/lanes.js";
import { LockstepChart } from "./charts/lockstep_chart.js";
import { PlaceErrors, Values } from "./charts/values.js";
import { Focus } from "./focus.js";
import { Layout } from "./layout.js";
import { goals } from "./map/goals.js";
import { SwarmMap } from "./map/map.js";
import { column, counted, largest, scaled, write } from "./numbers.js";
import { part } from "./part.js";
import { Answers } from "./panels/answers.js";
import { Controls } from "./panels/controls.js";
import { Events } from "./panels/events.js";
import { Finder } from "./panels/finder.js";
import { Keys } from "./panels/keys.js";
import { Robots } from "./panels/robots.js";
import { Runs } from "./panels/runs.js";
import { held, Series } from "./series.js";
import { Store } from "./store.js";
import { theme } from "./theme.js";
import { Bracket } from "./time/bracket.js";
import { Keep } from "./time/keep.js";
import { Pace } from "./time/pace.js";
import { Player } from "./time/player.js";
import { Present } from "./time/present.js";
import { Strip } from "./time/strip.js";

const SILENCE_MS = 1500; // the server speaks 25 times a second, 5 for a crowd
const [RETRY_MS, LONGEST_MS] = [250, 4000]; // from one try to reach the server to the next, twice as long each time
const [PATIENCE_MS, LOOK_MS] = [10000, 20];
const PLAYER_MS = 100;
const WORTHS = 12; // robots up to which values stand behind all names on the map
const NEWS_MS = 250; // what happens, and what came of acts
const NUMBERS = 2; // looks at the news of which one is at numbers, too: nobody reads faster, and each such look paints most of the page

const find = (selector) => document.querySelector(selector);
const store = new Store();
const wanted = new URLSearchParams(location.search);
const directed = wanted.has("directed"); // by a program that takes pictures: the page shows what it is told to, when it is
let socket = null, heard = -Infinity, selected = null, first = true, looks = 0, tries = 0, retry = null, next = 0;

const ask = (question) => {
  if (socket?.readyState === WebSocket.OPEN) {
    socket.send(JSON.stringify(question));
    return true;
  }
  if (question.do?.act === "stop" && socket?.readyState === WebSocket.CLOSED) connect(); // it does not wait for the next try
  return false;
};
const focus = new Focus(store);
const series = new Series(store, ask);
const map = new SwarmMap(find("#map canvas"), store, select);
const lockstepChart = new LockstepChart(find("#lockstep"), store, select);
const lanes = new Lanes(find("#lanes"), store, series, focus, select);
const values = new Values(find("#values"), store, series, focus);
const errors = new PlaceErrors(find("#error"), store, series, focus);
const robots = new Robots(find("#robots"), { store, series, focus, values, select });
const events = new Events(find("#events"), store);
const answers = new Answers(find("#answers"), { store, series, focus, values, lockstepChart, lanes, events });
const keys = new Keys(find("#keys"), store, (topic, path) => values.open(topic, path));
const controls = new Controls(store, ask, focus);
const strip = new Strip(find("#player"), store, series, values);
const bracket = (strip.bracket = new Bracket(find("#track"), store, strip));
const player = new Player(find("#player"), store, ask, strip);
const present = new Present(find("#player"), store, ask, strip, () => {
  tries = 0;
  socket.close();
});
const pace = new Pace(find("#virtual"), store, ask);
const layout = new Layout(find("main"), find("#layout"), find("#arrange"), store, ask);
const runs = new Runs(find("#runs"), find("#difference"), { store, series, focus, values, ask });
const keep = new Keep(find("#keep"), { store, bracket, values, tell: (text, bad) => controls.tell(text, bad) });
map.place = ({ robot, x, y }) => controls.act({ act: "place", robot, x, y });
const time = () => (store.swarm?.recording ? player : present);
new Finder(find("#finder"), { store, select, time, answers, controls, layout, runs, toggleTheme });

function select(name) {
  selected = name === selected ? null : name;
  map.selected = selected;
  keys.show(selected);
  controls.shown = "";
  find("main").classList.toggle("chosen", Boolean(selected));
  map.wake();
  if (!directed) panels(performance.now());
}

function connect() {
  clearTimeout(retry);
  const began = performance.now();
  socket = new WebSocket(`ws://${location.host}/live${location.search}`);
  first = true;
  present.asked = null; // an instant of the past that was looked at is asked for again
  socket.onopen = () => controls.connected();
  socket.onmessage = ({ data }) => {
    heard = performance.now();
    if (heard > began + SILENCE_MS) tries = 0; // it lasts
    take(JSON.parse(data));
  };
  socket.onclose = () => {
    const wait = tries ? Math.min(LONGEST_MS, RETRY_MS * 2 ** (tries - 1)) : 0;
    tries += 1;
    next = performance.now() + wait;
    retry = setTimeout(connect, wait);
  };
}

// What the page does about a server that it does not hear.
function trying(now) {
  if (socket.readyState === WebSocket.OPEN) return "waits for an answer";
  return socket.readyState === WebSocket.CLOSED && next > now + 500 ? `tries again in ${Math.round((next - now) / 1000)} s` : "tries again";
}

function take(step) {
  if (step.series) {
    looks = 0;
    return series.answered(step.series);
  }
  if (step.look) return look(step.look);
  if (step.runs) return runs.listed(step.runs);
  if (step.beside !== undefined) return runs.put(step.beside);
  if (step.layouts) store.layouts = step.layouts;
  if (step.act) controls.halted(step);
  if (step.refused || step.done) return controls.tell(step.refused ?? step.done, Boolean(step.refused));
  const opened = !first && step.swarm?.recording; // another recording
  if (opened) bracket.kept = null;
  const replaced = step.swarm?.recording ? (opened ? player.restart() : player.begin()) : store.swarm?.recording ? player.answered(step) : false;
  if (store.looking && !first) return glance(step);
  if (first || replaced || opened) {
    const swarm = first || opened ? null : store.swarm, marks = store.marks;
    store.clear();
    store.become(swarm);
    store.marks = marks;
    events.clear();
    lockstepChart.clear();
  }
  store.take(step, directed ? step.t * 1000 : heard);
  hear(step);
  part(() => lockstepChart.take(step));
  if (!first && !replaced) part(() => controls.take(step));
  part(() => series.take(step));
  if (first || opened) series.refill();
  first = false;
  player.taken();
  if (!directed) map.look();
}

// While somebody looks back only stops are listened to, and the series go on.
function glance(step) {
  series.take(step);
  hear(step);
}

function hear(step) {
  store.newest = step.t;
  store.hear(step);
  if (!first) controls.hear(step);
}

// An instant of the past.
function look(step) {
  if (present.wanted === null) return;
  const { swarm, services, newest, edges, stops, reached, pace } = store;
  store.clear();
  store.become(swarm);
  Object.assign(store, { services, newest, stops, reached, pace, looking: true });
  if (!store.edges.length) store.edges = edges;
  events.clear();
  lockstepChart.clear();
  store.take(step, performance.now() - 1000);
  map.wake();
}

function panels(now) {
  news();
  numbers(now);
}

function news() {
  const connection = find("#connection"), silent = performance.now() - heard > SILENCE_MS, recording = store.swarm?.recording;
  const [text, kind] = silent ? (tries || heard > -Infinity ? ["server lost", "bad"] : ["connecting", "muted"]) : recording ? ["recording", "muted"] : store.looking ? ["looks back", "warn"] : store.live ? ["live", "good"] : [store.swarm?.kind === "robots" ? "no robot in reach" : "the run has ended", "warn"];
  if (connection.textContent !== text) [connection.textContent, connection.className] = [text, kind];
  write(find("#trying"), silent && text !== "connecting" ? trying(performance.now()) : "");
  part(head);
  store.zoom = bracket.range;
  for (const draw of [chooseApp, () => layout.draw(), () => events.draw(store.events), () => controls.draw(selected, map, silent), () => pace.draw(), () => keep.draw()]) part(draw);
  find("#tabs [data-panel=control]").hidden = find("#control").hidden;
}

// What the page is about.
function head() {
  const recording = store.swarm?.recording, about = store.swarm ? `${store.swarm.kind}${recording ? ` ${recording.name}` : ""} · ${counted(store.names.length)}${focus.app ? ` · ${focus.kind}` : ""}${directed && recording ? ` · ${store.t.toFixed(2)} s` : ""}` : "";
  write(find("#kind"), about);
  find("#speed").hidden = !recording;
}

function numbers(now) {
  part(() => steps(now));
  for (const each of [runs, answers, values, errors, robots]) part(() => each.draw(now, selected));
  for (const draw of [label, () => keys.draw(), () => bracket.draw(), () => strip.draw(now)]) part(draw);
  if (!directed && store.swarm && !store.swarm.recording) part(() => present.draw(now));
}

// Who has done which iterations, or when which steps.
function steps(now) {
  const kindOf = focus.kind, lockstep = kindOf === "lockstep";
  find("#lockstep").hidden = !lockstep;
  find("#lanes").hidden = lockstep;
  lockstepChart.follow(lockstep ? focus.app : null);
  if (lockstep) lockstepChart.draw(selected);
  else {
    write(find("#lanes h2"), kindOf === "periodic" ? "Steps" : "Handled");
    write(find("#lanes .unit"), lanes.said);
    lanes.draw(now, selected);
  }
}

// What stands behind the robots' names on the map.
function label() {
  const value = values.first, entry = value && series.want(value), at = store.swarm?.recording || store.looking ? store.t : Infinity;
  const newest = new Map(entry ? series.robots(entry).map((name) => [name, held(series.points(entry, name), at)?.[1]]) : []);
  const { unit, factor } = scaled(value?.unit ?? "", largest([...newest.values()].map((each) => Math.abs(each ?? 0))));
  const text = column([...newest.values()].map((each) => each * factor));
  const texts = new Map([...newest].map(([name, each]) => [name, each === undefined ? "" : `${text(each * factor)}${unit && ` ${unit}`}`]));
  map.worth = (name) => (store.names.length <= WORTHS || name === selected ? texts.get(name) ?? "" : "");
  map.goals = goals(store);
  map.waiting = new Set(answers.waiting().keys());
}

function chooseApp() {
  const choice = find("#app"), apps = focus.apps, names = apps.join();
  if (choice.dataset.names !== names) {
    choice.dataset.names = names;
    choice.replaceChildren(...apps.map((app) => new Option(app.slice(4), app)));
    choice.hidden = !apps.length;
  }
  if (choice.value !== (focus.app ?? "")) choice.value = focus.app ?? "";
}

// As a program wants it: an instant of a recording, or what is live now.
async function show(t) {
  if (t !== undefined) await player.seek(t);
  const now = t === undefined ? performance.now() : t * 1000;
  panels(now);
  await settled();
  for (const each of [values, errors, robots, lanes, strip, answers]) each.drawn = each.sparked = each.judgedAt = -Infinity;
  panels(now);
  map.draw(now);
}

// Until the server has told all that charts have asked for.
async function settled() {
  for (let waited = 0; waited < PATIENCE_MS && [...series.entries.values()].some((entry) => !series.settled(entry)); waited += LOOK_MS) {
    await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
  }
}

function toggleTheme() {
  theme.toggle();
  for (const each of [values, errors, strip]) each.drawn = -Infinity;
  map.wake();
}

theme.set(wanted.get("theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
find("#theme").addEventListener("click", toggleTheme);
find("#app").addEventListener("change", ({ target }) => (focus.chosen = target.value));
find("#play").addEventListener("click", () => time().toggle());
find("#time").addEventListener("input", ({ target }) => time().go(Number(target.value)));
find("#keys .close").addEventListener("click", () => selected && select(selected));
for (const button of document.querySelectorAll("#tabs button")) button.addEventListener("click", () => answers.go(button.dataset.panel));
for (const button of document.querySelectorAll("#map [data-layer]")) {
  button.addEventListener("click", () => {
    button.ariaPressed = String((map.layers[button.dataset.layer] = !map.layers[button.dataset.layer]));
    map.wake();
  });
}
for (const [name, part] of [["--foot", find("footer")], ["--halt", find("#halt")]]) new ResizeObserver(() => document.documentElement.style.setProperty(name, `${part.offsetHeight}px`)).observe(part);

// For whoever measures or takes pictures.
window.swarmView = { store, series, focus, map, lockstepChart, lanes, values, errors, answers, player, present, bracket, layout, runs, show, settled, select, get selected() { return selected; } };
connect();

const charts = wanted.getAll("chart").map((chart) => [chart.slice(0, chart.indexOf(":")), chart.slice(chart.indexOf(":") + 1).split(".")]);
if (charts.length) values.beside(charts);
if (directed) document.body.classList.add("directed");
else {
  // In its own rhythm: the table need not be drawn as often as the map.
  setInterval(() => {
    const now = performance.now();
    news();
    if (looks++ % NUMBERS === 0) numbers(now);
    map.wake(); // estimates and trails, too
  }, NEWS_MS);
  setInterval(() => store.swarm?.recording && player.draw(performance.now()), PLAYER_MS);
}
