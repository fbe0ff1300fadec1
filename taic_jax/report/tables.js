// Tables: runs, results of methods, sweeps, and configs side by side.

// A row of a table is its cells: text, elements, or td and th of one's own.
function table(label, heads, rows, kind) {
  return make("div", { class: "wide", role: "region", tabindex: 0, "aria-label": label },
    make("table", { class: kind },
      make("thead", {}, make("tr", {}, heads.map((head) => (head.tagName === "TH" ? head : make("th", { scope: "col" }, head))))),
      make("tbody", {}, rows)));
}

const cell = (content, kind) => make("td", { class: kind }, content);
const numeric = (...contents) => contents.map((content) => cell(content, "n"));
const rowHead = (...content) => make("th", { scope: "row" }, content);
const badge = (text, kind = "partial") => make("span", { class: `badge ${kind}` }, text);
const list = (texts, kind) => make("ul", { class: kind }, texts.map((text) => make("li", {}, text)));
const notes = (texts) => texts.length > 0 && list(texts, "notes");
const differ = (values) => (unique(values).length > 1 ? "differs" : null);

function factsTable() {
  const commits = differ(data.runs.map((run) => run.facts.commit).filter(Boolean));
  const rows = data.runs.map(({ name, folder, facts, notes: own }) => {
    const { commit, ticks, written, run: seconds } = facts;
    return make("tr", {}, fill(rowHead(name, notes(own)), { title: folder }, []),
      cell(facts.finished ? badge("finished", "done") : badge("partial")), cell(facts.tasks.join(", ")),
      numeric(facts.seeds, count(ticks), count(seconds || null), count(facts.compile || null), count(ticks && seconds ? ticks / seconds : null)),
      cell(commit ? make("code", { title: commit }, commit.slice(0, 8) + (commit.endsWith("-dirty") ? "-dirty" : "")) : "–", commits),
      cell(written ? new Date(written * 1000).toISOString().slice(0, 16).replace("T", " ") + " UTC" : "–"));
  });
  return table("What was run", ["run", "state", "tasks", "seeds", "ticks in all", "seconds", "of compilation", "ticks/s", "commit", "last written"], rows);
}

function versionsTable() {
  const runs = data.runs.filter(({ facts }) => Object.keys(facts.versions).length || facts.machine);
  if (!runs.length) return null;
  const columns = runs.map(({ facts }) => ({ machine: facts.machine ? words(facts.machine) : "not recorded", ...facts.versions }));
  const rows = unique(columns.flatMap(Object.keys)).map((name) => {
    const values = columns.map((column) => column[name] ?? "–");
    return make("tr", { class: differ(values) }, rowHead(name), values.map((value) => cell(value)));
  });
  return make("details", {}, make("summary", {}, "Versions and machine"), table("Versions", ["", ...runs.map((run) => run.name)], rows));
}

function words(value) {
  if (value === null || value === undefined) return "–";
  if (Array.isArray(value)) return value.length ? value.map(words).join(", ") : "[]";
  if (typeof value === "object") return Object.entries(value).map(([name, own]) => `${name} ${words(own)}`).join(", ");
  return value === "" ? "\u2018\u2019" : String(value);
}

// ---- results

function resultTables() {
  const all = data.runs.flatMap((run) => run.methods.map((method) => ({ run, method })));
  return unique(all.map(({ method }) => method.task)).map((task) => {
    const rows = all.filter(({ method }) => method.task === task);
    const summaries = rows.flatMap(({ method }) => [method.return, method.return_untrained].filter(Boolean));
    const range = extent(summaries.flatMap((summary) => [...summary.per_seed, ...summary.ci95]));
    return make("div", {}, make("h3", {}, task), table(`Results on ${task}`,
      ["run", "method", "untrained", "after training", "per seed", "mean options", "duration", "interactions", "pre-training", "seeds"],
      rows.map(({ run, method }) => resultRow(run, method, range)), "results"),
      range && make("p", { class: "fine" }, `Scale of the column per seed: ${number(range[0])} to ${number(range[1])}; ○ untrained IQM, dots seeds, bar the 95 % interval, line the interquartile mean (IQM). Duration: ticks an option.`));
  });
}

function resultRow(run, method, range) {
  const { finished, seeds } = run.facts;
  const { colour, dashed } = run.stages.find((stage) => stage.stage === method.stage) ?? { colour: "var(--c0)" };
  const unknown = method.uncounted.length ? ` + unknown of ${method.uncounted.join(", ")}` : "";
  return make("tr", { "data-stage": method.stage }, rowHead(run.name, !finished && badge("partial")),
    cell([swatch({ colour, dashed }), method.label, !finished && !method.evaluated && badge("not evaluated yet")]),
    cell(twoLines(method.return_untrained), "n"), cell(twoLines(method.return), "n strong"),
    cell(method.return ? strip(method, range, colour) : "–"),
    numeric(twoLines(method.return_mean_option), number(method.duration?.iqm, 3), count(method.ticks),
      (method.pretraining || !unknown ? count(method.pretraining) : "") + unknown,
      (method.return?.per_seed.length ?? seeds) + (method.return?.iqm === null ? ", some stopped" : "")));
}

// The number, and its interval below it.
const twoLines = (summary) =>
  [number(summary?.iqm), summary && summary.ci95[0] !== null && make("small", {}, bounds(summary.ci95))];

function strip({ return: { per_seed: seeds, iqm, ci95 }, return_untrained: before }, range, colour) {
  const [width, height] = [170, 26];
  const { toX } = frameOf(width, height, range, [0, 1], false, { left: 8, right: 8, top: 0, bottom: 0 });
  return draw("svg", { class: "strip", width, height, role: "img", style: `--own:${colour}`, "aria-label": `per seed: ${seeds.map((s) => number(s)).join(", ")}` },
    draw("line", { class: "grid", x1: 4, x2: width - 4, y1: 13, y2: 13 }),
    ci95[0] !== null && draw("rect", { class: "band", x: toX(ci95[0]), y: 7, width: Math.max(1, toX(ci95[1]) - toX(ci95[0])), height: 12, rx: 2 }),
    seeds.filter((seed) => seed !== null).map((seed) => draw("circle", { class: "dot", cx: toX(seed), cy: 13, r: 2.6 })),
    before && before.iqm !== null && draw("circle", { class: "ring", cx: toX(before.iqm), cy: 13, r: 4 }),
    iqm !== null && draw("line", { class: "mean", x1: toX(iqm), x2: toX(iqm), y1: 4, y2: 22 }));
}

// Measures of options that were learnt from data alone.
function measureSection() {
  const runs = data.runs.filter((run) => Object.keys(run.measures).length);
  const rows = unique(runs.flatMap((run) => Object.keys(run.measures))).map((name) =>
    make("tr", {}, rowHead(name), runs.map((run) => cell(twoLines(run.measures[name]), "n"))));
  return runs.length > 0 && section("measures", "Measures of options", table("Measures of options", ["", ...runs.map((run) => run.name)], rows));
}

// ---- sweeps

function sweepTable(sweep) {
  const columns = ["point", ...sweep.axes, "iqm", "low", "high", "untrained", "diverged", "seeds"];
  let [by, up] = ["iqm", false];
  const order = ({ [by]: x }, { [by]: y }) =>
    (up ? 1 : -1) * (Number.isFinite(+x) && Number.isFinite(+y) ? x - y : String(x).localeCompare(String(y)));
  const heads = columns.map((name) => make("th", { scope: "col", "aria-sort": "none" },
    make("button", { type: "button", class: "sort", click: () => { [by, up] = [name, by === name ? !up : name !== "iqm"]; show(); } }, name)));
  const wrap = table(`Table of sweep ${sweep.name}`, heads, []);
  const show = () => {
    heads.forEach((head, i) => head.setAttribute("aria-sort", columns[i] !== by ? "none" : up ? "ascending" : "descending"));
    const rows = sweep.table.toSorted(order).map((row) => make("tr", {}, numeric(...columns.map((name) => row[name] ?? ""))));
    wrap.querySelector("tbody").replaceChildren(...rows);
  };
  show();
  return make("div", { class: "sweep" }, make("h3", {}, `Sweep ${sweep.name}: ${sweep.points} points`),
    notes(sweep.notes), wrap);
}

// ---- configs

function configTable() {
  const names = unique(data.runs.flatMap((run) => Object.keys(run.config)));
  const single = data.runs.length === 1;
  const rows = names.map((name) => {
    const values = data.runs.map((run) => (name in run.config ? words(run.config[name]) : "not there"));
    const compared = single && name in data.defaults ? [...values, words(data.defaults[name])] : values;
    return make("tr", { class: differ(compared), "data-field": name }, rowHead(make("code", {}, name)), values.map((value) => cell(make("code", {}, value))));
  });
  const wrap = table("Configs", ["field", ...data.runs.map((run) => run.name)], rows, "config");
  redraws.push(() => { wrap.classList.toggle("only", view.fields !== "all"); });
  const differing = rows.filter((row) => row.className).length;
  return make("details", { open: true },
    make("summary", {}, `${differing} of ${names.length} fields: what differs ${single ? "from the defaults" : "among the runs"}`),
    toggle("show every field", "fields", "all", ""), wrap);
}
