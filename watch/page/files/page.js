// The page: its connection, its buttons, and the picture of what came.
import { Charts } from "./charts.js";
import { Frames } from "./frames.js";
import { Panels, make, showLaw } from "./panels.js";
import { Store } from "./store.js";

const $ = (id) => document.getElementById(id);
const SILENT_MS = 2000; // the server speaks ten times a second, whatever the rig does
const WINDOWS = [["10 s", 10], ["30 s", 30], ["2 min", 120], ["10 min", 600]];

const page = { store: null, charts: null, panels: null, hello: null, state: null, events: [], frames: null, seconds: 30, paused: null, heard: 0, socket: null };
window.softloop = page; // for a person with a console, and for tests

// ---- the connection: comes back by itself

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => { page.heard = performance.now(); take(data); };
  socket.onclose = () => {
    if (page.socket !== socket) return;
    page.socket = null;
    show("lost");
    setTimeout(connect, 500 + 500 * Math.random());
  };
  page.socket = socket;
  page.heard = performance.now();
}

function watch() {
  if (page.socket && performance.now() - page.heard > SILENT_MS) {
    const silent = page.socket;
    page.socket = null;
    silent.onclose = null;
    silent.close();
    show("lost");
    connect();
  }
  const old = (performance.now() - page.heard) / 1000;
  $("lost-age").textContent = document.body.dataset.connection === "lost" ? `Silent for ${old.toFixed(0)} s; trying again.` : "";
}

function show(connection) {
  document.body.dataset.connection = connection;
  $("connection").textContent = { live: "live", idle: "rig not running", lost: "LOST", connecting: "connecting" }[connection];
  $("lost").hidden = connection !== "lost";
  if (connection !== "live") $("arm").disabled = $("disarm").disabled = true;
}

function take(data) {
  if (data instanceof ArrayBuffer) { page.store.take(data); return; }
  const told = JSON.parse(data);
  if (told.kind === "hello") greet(told);
  else if (told.kind === "begin") page.store.clear();
  else if (told.kind === "events") { page.events = told.events; page.panels.events(told.events); }
  else if (told.kind === "state") update(told);
}

function greet(hello) {
  page.hello = hello;
  page.store = new Store(hello.columns);
  page.charts = new Charts($("plots"), page.store, hello.columns);
  page.panels = new Panels(hello);
  experiments(hello);
  faults(hello);
}

function update(state) {
  const heard = (page.stateAt = performance.now());
  page.state = state;
  show(state.running ? "live" : "idle");
  const gate = state.gate.state;
  $("arm").textContent = gate === "fault" ? "Re-arm" : "Arm";
  $("arm").disabled = !state.running || gate === "armed" || gate === "silent";
  $("disarm").disabled = !state.running || gate !== "armed";
  if (state.parameters && !page.hello.parameters?.length) {
    page.hello.parameters = state.parameters;
    page.panels.parameters(state.parameters);
  }
  page.dirty = heard;
  answered(gate);
  experimentState(state.experiment);
  faultState(state);
}

// ---- the emergency stop: on press, three ways at once, until the gate says FAULT

const stopping = { until: 0, timer: 0 };

function stop(event) {
  event?.preventDefault();
  $("stop").classList.add("sent");
  stopping.until = performance.now() + 5000;
  say("Stop sent ...");
  sendStop();
  clearInterval(stopping.timer);
  stopping.timer = setInterval(() => {
    if (performance.now() < stopping.until) { sendStop(); return; }
    clearInterval(stopping.timer);
    $("stop").classList.remove("sent");
    say("NO ANSWER from the gate. Use the hardware stop.");
  }, 250);
}

function sendStop() {
  if (page.socket?.readyState === WebSocket.OPEN) page.socket.send("stop"); // the one way that is open already, so the quickest
  const own = page.hello?.stop_port ? [`${location.protocol}//${location.hostname}:${page.hello.stop_port}/stop`] : [];
  for (const url of [...own, "/stop"]) {
    fetch(url, { method: "POST", mode: "no-cors", credentials: "include", keepalive: true }).catch(() => {});
  }
}

function answered(gate) {
  if (!stopping.until || gate !== "fault") return;
  clearInterval(stopping.timer);
  stopping.until = 0;
  $("stop").classList.remove("sent");
  say("Stopped: the gate is in FAULT and vents.");
}

$("stop").addEventListener("pointerdown", (event) => { if (event.button === 0) stop(event); });
$("stop-form").addEventListener("submit", stop); // the keyboard's way, and a finger's on old browsers

// ---- the other buttons

function say(words) { $("answer").textContent = words; }

async function post(path, body) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body ?? {}) });
  return answer.json();
}

async function request(action) {
  say(`Asked the gate to ${action} ...`);
  try {
    const answer = await post(`/request/${action}`);
    const gate = page.state?.gate ?? { state: "silent", reason: "none" };
    const why = gate.reason === "none" ? "" : ` (${gate.reason})`;
    say(answer.obeyed ? "" : `Not done: ${answer.error ?? `gate ${gate.state}${why}`}`);
  } catch {
    say("The request did not reach the server.");
  }
}

$("arm").addEventListener("click", () => request("arm"));
$("disarm").addEventListener("click", () => request("disarm"));

function experiments(hello) {
  const choices = hello.experiments;
  $("experiment").hidden = !choices;
  if (!choices) return;
  const form = $("experiment-form");
  for (const name of ["law", "trajectory"]) {
    form.elements[name].replaceChildren(...choices[name].map((value) => make("option", "", value)));
    form.elements[name].value = hello[name];
  }
}

function experimentState(state) {
  if (!state) return;
  $("start").disabled = state.running;
  $("end").disabled = !state.running;
  if ($("experiment-state").textContent !== state.text) $("experiment-state").textContent = state.text;
  if (state.law) showLaw(state);
}

$("experiment-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target.elements;
  $("start").disabled = true;
  const answer = await post("/action/start", { law: form.law.value, trajectory: form.trajectory.value, duration_s: Number(form.duration_s.value) || 0 });
  say(answer.error ? `Not started: ${answer.error}` : "");
});
$("end").addEventListener("click", async () => { const answer = await post("/action/end"); say(answer.error ?? ""); });

// ---- faults, of a simulated rig alone

function faults(hello) {
  $("faults").hidden = !hello.actions?.includes("fault");
  if ($("faults").hidden) return;
  $("fault-form").elements.kind.replaceChildren(...hello.faults.map(({ kind }) => {
    const option = make("option", "", kind.replaceAll("_", " "));
    option.value = kind;
    return option;
  }));
  faultState(null);
}

function faultState(state) {
  if ($("faults").hidden) return;
  const form = $("fault-form").elements;
  const plant = Boolean(state?.running && state.processes.some((p) => p.name === "plant" && p.heard_s < 2.5));
  const unit = page.hello.faults.find(({ kind }) => kind === form.kind.value)?.unit ?? "";
  for (const element of form) element.disabled = !plant;
  form.size.disabled = !plant || !unit;
  form.size.required = plant && Boolean(unit);
  form.size.placeholder = unit ? "" : "has none";
  $("fault-unit").textContent = unit;
  const broken = plant ? state.broken : [];
  $("mend").disabled = !broken.length;
  $("fault-state").classList.toggle("broken", broken.length > 0);
  const whole = plant ? "nothing is broken" : "no simulated plant is running here";
  $("fault-state").textContent = broken.length ? `broken: ${broken.join(", ").replaceAll("_", " ")}` : whole;
}

async function askPlant(asked) {
  try {
    const answer = await post("/action/fault", asked);
    say(answer.error ? `Not done: ${answer.error}` : "");
  } catch {
    say("The request did not reach the server.");
  }
}

$("fault-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const { kind, size, duration_s: duration } = event.target.elements;
  const asked = { action: "break", kind: kind.value, duration_s: Number(duration.value) || 0 };
  if (!size.disabled) asked.size = Number(size.value);
  askPlant(asked);
});
$("fault-form").elements.kind.addEventListener("change", () => faultState(page.state));
$("mend").addEventListener("click", () => askPlant({ action: "mend" }));

// ---- time shown, pause, keys

function choose(seconds) {
  page.seconds = seconds;
  for (const button of $("windows").children) button.setAttribute("aria-pressed", `${Number(button.value) === seconds}`);
}

for (const [name, seconds] of WINDOWS) {
  const button = make("button", "", name);
  button.type = "button";
  button.value = `${seconds}`;
  button.addEventListener("click", () => choose(seconds));
  $("windows").append(button);
}
choose(30);

function pause() {
  page.paused = page.paused === null && page.store ? now() : null;
  $("pause").setAttribute("aria-pressed", `${page.paused !== null}`);
}
$("pause").addEventListener("click", pause);

document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") { stop(event); return; }
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
  if (event.key === "p") pause();
  const chosen = WINDOWS[Number(event.key) - 1];
  if (chosen) choose(chosen[1]);
});

// ---- drawing, at most thirty times a second, and not at all while nobody looks

// The newest time that came.
function now() { return Math.max(0, page.store.last); }

function picture() {
  if (!page.charts || !page.store.count) return [];
  const to = page.paused ?? now();
  const clock = () => { $("clock").textContent = `${page.paused === null ? "" : "paused at "}${to.toFixed(2)} s`; };
  return [clock, ...page.charts.parts(page.seconds, to)];
}

function footer() {
  frames.count();
  const state = page.state, viewers = state?.viewers ?? 0;
  $("footer").textContent = `${frames.fps.toFixed(0)} pictures a second, ${viewers} viewer${viewers === 1 ? "" : "s"}`;
}

const frames = (page.frames = new Frames(picture));

show("connecting");
connect();
setInterval(footer, 1000);
setInterval(watch, 250);
setInterval(() => { if (page.panels && page.dirty) { page.dirty = 0; page.panels.state(page.state); } }, 100);
