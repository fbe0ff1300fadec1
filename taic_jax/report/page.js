// Drawing of the report: elements, numbers in words, and the state of the view, which lives in the address.
"use strict";

window.addEventListener("error", (event) => { document.body.dataset.errors = event.message; });

const data = JSON.parse(document.getElementById("data").textContent);

// Make an element; text stays text, so that no config or name of a run becomes markup.
const make = (name, attributes, ...children) => fill(document.createElement(name), attributes, children);
const SVG = "http://www.w3.org/2000/svg";
const draw = (name, attributes, ...children) => fill(document.createElementNS(SVG, name), attributes, children);

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name, value);
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child || child === 0));
  return element;
}

const unique = (values) => [...new Set(values)];

// ---- numbers

function number(x, digits = 4) {
  if (!Number.isFinite(x)) return "–"; // null and undefined too
  if (x === 0) return "0";
  const size = Math.abs(x);
  const text = size >= 1e7 || size < 1e-4 ? size.toExponential(2).replace("e+", "e").replace("e-", "e\u2212")
    : size >= 10 ** (digits - 1) ? count(size) : String(Number(size.toPrecision(digits)));
  return x < 0 ? "\u2212" + text : text;
}

const count = (x) => (Number.isFinite(x) ? Math.round(x).toLocaleString("fr") : "–"); // thin spaces between thousands
const percent = (share, digits) => number(100 * share, digits) + " %";

// Ticks of an axis: 250 k, 1 M.
function short(x) {
  const size = Math.abs(x);
  return size >= 1e6 ? number(x / 1e6) + "\u202fM" : size >= 1e3 ? number(x / 1e3) + "\u202fk" : number(x);
}

function extent(values) {
  const finite = values.filter(Number.isFinite);
  return finite.length ? finite.reduce(([low, high], x) => [Math.min(low, x), Math.max(high, x)], [Infinity, -Infinity]) : null;
}

const bounds = ([low, high]) => (low === null ? "" : `${number(low)} … ${number(high)}`);

// ---- the view's state: #metric=entropy&x=all&seeds=off, so that any view is a link

const DEFAULTS = { metric: "return", x: "alone", seeds: "on", band: "on", log: "off", hide: "", zoom: "", coordinate: "", fields: "" };
const view = { ...DEFAULTS };
const redraws = []; // every drawing that depends on the view

function readAddress() {
  Object.assign(view, DEFAULTS);
  for (const [name, value] of new URLSearchParams(location.hash.slice(1))) if (name in DEFAULTS) view[name] = value;
}

function change(changes) {
  Object.assign(view, changes);
  const changed = Object.entries(view).filter(([name, value]) => value !== DEFAULTS[name]);
  try {
    history.replaceState(null, "", changed.length ? "#" + new URLSearchParams(changed) : location.pathname + location.search);
  } catch { /* some viewers of files refuse it */ }
  redraw();
}

const redraw = () => { for (const one of redraws) one(); };

// Settings that one field of the address holds for many drawings: "a:1,b:2".
function settings(name) {
  return new Map(view[name].split(",").filter(Boolean).map((item) => item.split(":").map(decodeURIComponent)).map(([key, ...values]) => [key, values]));
}

function changeSetting(name, key, values) {
  const all = settings(name).set(key, values);
  if (!values) all.delete(key);
  change({ [name]: [...all].map((item) => item.flat().map(encodeURIComponent).join(":")).join(",") });
}

// ---- controls

function toggle(label, name, on = "on", off = "off") {
  const box = make("input", { type: "checkbox", change: () => change({ [name]: box.checked ? on : off }) });
  redraws.push(() => { box.checked = view[name] === on; });
  return make("label", { class: "control" }, box, label);
}

function choice(label, options, value, chosen) {
  const list = make("select", { change: () => chosen(list.value) }, options.map(([value, text]) => make("option", { value }, text)));
  redraws.push(() => { list.value = value(); });
  return make("label", { class: "control" }, label, list);
}

const section = (id, title, ...children) =>
  make("section", { id, "aria-labelledby": id + "-title" }, make("h2", { id: id + "-title", tabindex: -1 }, title), children);

// Draw a figure at the width of its place, anew when that or the view changes.
function onWidth(host, drawAt) {
  let width = 0;
  const update = () => drawAt((width = Math.floor(host.clientWidth) || width || 640));
  const resized = () => { if (host.clientWidth && Math.abs(host.clientWidth - width) > 1) update(); };
  new ResizeObserver(() => requestAnimationFrame(resized)).observe(host);
  redraws.push(update);
}
