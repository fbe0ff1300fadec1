// Drawing of the report: elements, numbers in words, and the state of the view, which lives in the address.
"use strict";

const errors = [];
window.addEventListener("error", (event) => {
  errors.push(event.message);
  document.body.dataset.errors = errors.join("; ");
});

const data = JSON.parse(document.getElementById("data").textContent);
const SVG = "http://www.w3.org/2000/svg";
const COLOURS = 8; // --c0 ... --c7 in page.css

// Make an element; text is set as text, so nothing in a run's config or name can become markup.
function make(name, attributes, ...children) {
  return fill(document.createElement(name), attributes, children);
}

function draw(name, attributes, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (typeof value === "function") element.addEventListener(name, value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== ""));
  return element;
}

// ---- numbers

function group(text) {
  return text.replace(/\B(?=(\d{3})+(?!\d))/g, "\u202f");
}

function number(x, digits = 4) {
  if (x === null || x === undefined || !Number.isFinite(x)) return "–";
  if (x === 0) return "0";
  const size = Math.abs(x);
  let text;
  if (size >= 1e7 || size < 1e-4) text = size.toExponential(2).replace("e+", "e").replace("e-", "e\u2212");
  else if (size >= 10 ** (digits - 1)) text = group(size.toFixed(0));
  else text = String(Number(size.toPrecision(digits)));
  return x < 0 ? "\u2212" + text : text;
}

function count(x) {
  return x === null || x === undefined ? "–" : group(String(Math.round(x)));
}

// Ticks of an axis: 250 k, 1 M.
function short(x) {
  const size = Math.abs(x);
  if (size >= 1e6) return number(x / 1e6) + "\u202fM";
  if (size >= 1e3) return number(x / 1e3) + "\u202fk";
  return number(x);
}

// Between 3 and 8 round numbers that cover [low, high].
function roundNumbers(low, high, wanted = 5) {
  const raw = (high - low) / wanted || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) values.push(i * step);
  return values;
}

function extent(values) {
  let low = Infinity;
  let high = -Infinity;
  for (const value of values) {
    if (value === null || !Number.isFinite(value)) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low > high ? null : [low, high];
}

function interval(summary) {
  if (!summary || summary.iqm === null) return "–";
  const [low, high] = summary.ci95;
  return number(summary.iqm) + (low === null ? "" : ` (${number(low)} … ${number(high)})`);
}

// ---- the view's state: #metric=entropy&x=all&seeds=off, so that any view is a link

const DEFAULTS = { metric: "return", x: "alone", seeds: "on", band: "on", log: "off", hide: "", zoom: "", coordinate: "", fields: "" };
const view = { ...DEFAULTS };
const redraws = []; // every drawing that depends on the view

function readAddress() {
  const asked = new URLSearchParams(location.hash.slice(1));
  for (const name of Object.keys(DEFAULTS)) view[name] = asked.get(name) ?? DEFAULTS[name];
}

function change(changes) {
  Object.assign(view, changes);
  const kept = Object.entries(view).filter(([name, value]) => value !== DEFAULTS[name]);
  const hash = new URLSearchParams(kept).toString();
  try {
    history.replaceState(null, "", hash ? "#" + hash : location.pathname + location.search);
  } catch { /* some viewers of files refuse it; the view changes all the same */ }
  redraw();
}

function redraw() {
  for (const one of redraws) one();
}

// Settings that one field of the address holds for many drawings: "a:1,b:2".
function setting(name, key) {
  const found = view[name].split(",").map((item) => item.split(":")).find(([own]) => decodeURIComponent(own) === key);
  return found ? found.slice(1) : null;
}

function withSetting(name, key, values) {
  const others = view[name].split(",").filter((item) => item && decodeURIComponent(item.split(":")[0]) !== key);
  const own = values ? [[encodeURIComponent(key), ...values].join(":")] : [];
  return { [name]: [...others, ...own].join(",") };
}

// ---- controls

function toggle(label, name, on = "on", off = "off") {
  const box = make("input", { type: "checkbox", change: () => change({ [name]: box.checked ? on : off }) });
  redraws.push(() => { box.checked = view[name] === on; });
  return make("label", { class: "control" }, box, label);
}

function choice(label, options, selected, chosen) {
  const list = make("select", { change: () => chosen(list.value) },
    options.map(([value, text]) => make("option", { value, selected: value === selected }, text)));
  return { node: make("label", { class: "control" }, label, list), list };
}

function section(id, title, ...children) {
  return make("section", { id, "aria-labelledby": id + "-title" }, make("h2", { id: id + "-title" }, title), children);
}

// A figure redraws when its width changes, but not before it has one.
function onWidth(host, drawAt) {
  let width = 0;
  new ResizeObserver(() => {
    const now = Math.floor(host.clientWidth);
    if (now && Math.abs(now - width) > 1) drawAt((width = now));
  }).observe(host);
  redraws.push(() => { width = Math.floor(host.clientWidth) || width || 640; drawAt(width); });
}
