// Joins the page's parts: the connection to the server, the store, map, table, events, keys, charts, controls.

import { Charts } from "./charts.js";
import { LockstepChart } from "./lockstep_chart.js";
import { Controls } from "./controls.js";
import { SwarmMap } from "./map.js";
import { Events, Keys, Robots } from "./panels.js";
import { Pace } from "./pace.js";
import { Player } from "./player.js";
import { Store } from "./store.js";
import { theme } from "./theme.js";

const SILENCE_MS = 1500; // the server speaks 25 times a second, 5 for a crowd
const RETRY_MS = 500;
const PLAYER_MS = 100;
const PANELS_MS = 200; // as often as the server tells what they show

const find = (selector) => document.querySelector(selector);
const store = new Store();
const wanted = new URLSearchParams(location.search);
const directed = wanted.has("directed"); // by a program that takes pictures: the page shows what it is told to, when it is
let socket = null, heard = -Infinity, selected = null;

const ask = (question) => {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  if (question.history) question.history.t = store.t;
  socket.send(JSON.stringify(question));
  return true;
};
const charts = new Charts(find("#charts"), store, ask);
const map = new SwarmMap(find("#map canvas"), store, select);
const lockstepChart = new LockstepChart(find("#lockstep"), store, select);
const robots = new Robots(find("#robots tbody"), store, select);
const events = new Events(find("#events ol"));
const keys = new Keys(find("#keys"), store, (topic, path) => charts.open(topic, path));

const controls = new Controls(find("header"), find("#controls"), store, ask);

const player = new Player(find("#player"), store, ask);
const pace = new Pace(find("#pace"), store, ask);

function select(name) {
  selected = name === selected ? null : name;
  map.selected = selected;
  keys.show(selected);
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/live${location.search}`);
  let first = true;
  socket.onopen = () => controls.connected();
  socket.onmessage = ({ data }) => {
    heard = performance.now();
    const step = JSON.parse(data);
    if (step.history) return charts.history(step.history);
    if (step.refused || step.done) return controls.tell(step.refused ?? step.done, Boolean(step.refused));
    const replaced = step.swarm?.recording ? player.begin() : store.swarm?.recording ? player.answered(step) : false;
    if (first || replaced) {
      const swarm = first ? null : store.swarm;
      store.clear();
      store.become(swarm);
      events.clear();
      lockstepChart.clear();
    }
    store.take(step, directed ? step.t * 1000 : heard);
    lockstepChart.take(step);
    if (!first && !replaced) controls.take(step);
    charts.take(step);
    if (first || replaced) charts.refill();
    first = false;
    player.taken();
    if (!directed) map.wake();
  };
  socket.onclose = () => setTimeout(connect, RETRY_MS);
}

function panels(now) {
  const connection = find("#connection"), silent = performance.now() - heard > SILENCE_MS;
  const [text, kind] = silent ? ["server lost", "bad"] : store.swarm?.recording ? ["recording", "good"] : store.live ? ["live", "good"] : [store.swarm?.kind === "robots" ? "no robot in reach" : "the run has ended", "warn"];
  if (connection.textContent !== text) [connection.textContent, connection.className] = [text, kind];
  const about = store.swarm ? `${store.swarm.kind}, ${store.names.length} robots${directed && store.swarm.recording ? `, ${store.t.toFixed(2)} s` : ""}` : "";
  if (find("#kind").textContent !== about) find("#kind").textContent = about;
  lockstepChart.draw(selected);
  robots.draw(selected);
  events.draw(store.events);
  keys.draw();
  controls.draw(selected);
  pace.draw();
  charts.draw(now);
}

// As a program wants it: an instant of a recording, or what is live now.
async function show(t) {
  if (t !== undefined) await player.seek(t);
  const now = t === undefined ? performance.now() : t * 1000;
  panels(now);
  map.draw(now);
  charts.flush();
}

theme.set(wanted.get("theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
find("#theme").addEventListener("click", () => {
  theme.toggle();
  charts.restyle();
});

// For whoever measures or takes pictures.
window.swarmView = { store, map, lockstepChart, charts, player, show };
connect();

for (const chart of wanted.getAll("chart")) {
  const [topic, path] = chart.split(":");
  charts.open(topic, path.split("."));
}
if (directed) document.body.classList.add("directed");
else {
  // In its own rhythm: the table need not be drawn as often as the map.
  setInterval(() => {
    panels(performance.now());
    map.wake();
  }, PANELS_MS);
  setInterval(() => player.draw(performance.now()), PLAYER_MS);
}
