// Joins the page's parts: the connection to the server, the store, map, table, events, keys, charts, hands.

import { Charts } from "./charts.js";
import { Front } from "./front.js";
import { Hands } from "./hands.js";
import { SwarmMap } from "./map.js";
import { Events, Keys, Robots } from "./panels.js";
import { Pace } from "./pace.js";
import { Player } from "./player.js";
import { Store } from "./store.js";
import { theme } from "./theme.js";

const SILENCE_MS = 1500; // the server speaks 25 times a second, 5 for a crowd
const RETRY_MS = 500;
const PANELS_MS = 100;

const find = (selector) => document.querySelector(selector);
const store = new Store();
let socket = null, heard = -Infinity, selected = null;

const ask = (question) => {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  if (question.history) question.history.t = store.t;
  socket.send(JSON.stringify(question));
  return true;
};
const charts = new Charts(find("#charts"), store, ask);
const map = new SwarmMap(find("#map canvas"), store, select);
const front = new Front(find("#front"), store, select);
const robots = new Robots(find("#robots tbody"), store, select);
const events = new Events(find("#events ol"));
const keys = new Keys(find("#keys"), store, (topic, path) => charts.open(topic, path));

const hands = new Hands(find("header"), find("#hands"), store, ask);

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
  socket.onmessage = ({ data }) => {
    heard = performance.now();
    const step = JSON.parse(data);
    if (step.history) return charts.history(step.history);
    if (step.refused || step.done) return hands.tell(step.refused ?? step.done, Boolean(step.refused));
    const replaced = step.swarm?.recording ? player.begin() : store.swarm?.recording ? player.answered(step) : false;
    if (first || replaced) {
      const swarm = first ? null : store.swarm;
      store.clear();
      store.become(swarm);
      events.clear();
      front.clear();
    }
    store.take(step, heard);
    front.take(step);
    if (!first && !replaced) hands.take(step);
    charts.take(step);
    if (first || replaced) charts.refill();
    first = false;
  };
  socket.onclose = () => setTimeout(connect, RETRY_MS);
}

// In its own rhythm: the table need not be drawn as often as the map.
setInterval(() => {
  const connection = find("#connection"), silent = performance.now() - heard > SILENCE_MS;
  const [text, kind] = silent ? ["server lost", "bad"] : store.swarm?.recording ? ["recording", "good"] : store.live ? ["live", "good"] : [store.swarm?.kind === "robots" ? "no robot in reach" : "the run has ended", "warn"];
  if (connection.textContent !== text) [connection.textContent, connection.className] = [text, kind];
  find("#kind").textContent = store.swarm ? `${store.swarm.kind}, ${store.names.length} robots` : "";
  front.draw(selected);
  robots.draw(selected);
  events.draw(store.events);
  keys.draw();
  hands.draw(selected);
  player.draw(performance.now());
  pace.draw();
  charts.draw(performance.now());
}, PANELS_MS);

theme.set(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
find("#theme").addEventListener("click", () => {
  theme.toggle();
  charts.restyle();
});

// For whoever measures: pictures drawn, and how old the newest sample is.
window.swarmView = { store, map, front, get frames() { return map.frames; } };
connect();

// For a screenshot, which is taken when all has been loaded.
if (new URLSearchParams(location.search).has("settle")) document.body.append(Object.assign(new Image(), { src: `settled${location.search}`, hidden: true }));
