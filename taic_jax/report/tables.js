// Tables: what was run, what each method reached, sweeps, and configs side by side.

function table(label, heads, rows, attributes) {
  return make("div", { class: "wide", role: "region", tabindex: 0, "aria-label": label },
    make("table", attributes || {},
      make("thead", {}, make("tr", {}, heads.map((head) => make("th", { scope: "col" }, head)))),
      make("tbody", {}, rows)));
}

function cell(text, attributes) {
  return make("td", attributes || {}, text);
}

function badge(facts) {
  return facts.finished ? make("span", { class: "badge done" }, "finished") : make("span", { class: "badge partial" }, "partial");
}

function factsTable() {
  const various = (values) => new Set(values.filter(Boolean)).size > 1;
  const commits = various(data.runs.map((run) => run.facts.commit));
  const rows = data.runs.map(({ name, folder, facts, notes }) => make("tr", {},
    make("th", { scope: "row", title: folder }, name, notes.length ? make("ul", { class: "notes" }, notes.map((note) => make("li", {}, note))) : null),
    cell(badge(facts)), cell(facts.tasks.join(", ")), cell(`${facts.seeds}`, { class: "n" }), cell(count(facts.ticks), { class: "n" }),
    cell(facts.run ? count(facts.run) : "–", { class: "n" }), cell(facts.compile ? count(facts.compile) : "–", { class: "n" }),
    cell(facts.ticks && facts.run ? count(facts.ticks / facts.run) : "–", { class: "n" }),
    cell(facts.commit ? make("code", { title: facts.commit }, shortCommit(facts.commit)) : "–", { class: commits ? "differs" : null }),
    cell(facts.written ? new Date(facts.written * 1000).toISOString().slice(0, 16).replace("T", " ") + " UTC" : "–")));
  return table("What was run", ["run", "state", "tasks", "seeds", "ticks in all", "seconds", "of compilation", "ticks/s", "commit", "last written"], rows);
}

function shortCommit(commit) {
  return commit.slice(0, 8) + (commit.endsWith("-dirty") ? "-dirty" : "");
}

function versionsTable() {
  const finished = data.runs.filter((run) => Object.keys(run.facts.versions).length || run.facts.machine);
  if (!finished.length) return null;
  const names = [...new Set(finished.flatMap((run) => Object.keys(run.facts.versions)))];
  const row = (name, values) => make("tr", { class: new Set(values).size > 1 ? "differs" : null },
    make("th", { scope: "row" }, name), values.map((value) => cell(value)));
  const rows = names.map((name) => row(name, finished.map((run) => run.facts.versions[name] ?? "–")));
  const machines = finished.map((run) => (run.facts.machine ? words(run.facts.machine) : "not recorded"));
  return make("details", {}, make("summary", {}, "Versions and machine"),
    table("Versions", ["", ...finished.map((run) => run.name)], [row("machine", machines), ...rows]));
}

function words(value) {
  if (value === null || value === undefined) return "–";
  if (Array.isArray(value)) return value.length ? value.map(words).join(", ") : "[]";
  if (typeof value === "object") return Object.entries(value).map(([name, own]) => `${name} ${words(own)}`).join(", ");
  return value === "" ? "\u2018\u2019" : String(value);
}

// ---- results

function resultTables() {
  const tasks = [...new Set(data.runs.flatMap((run) => run.methods.map((method) => method.task)))];
  return tasks.map((task) => {
    const rows = data.runs.flatMap((run) => run.methods.filter((method) => method.task === task).map((method) => ({ run, method })));
    const told = rows.flatMap(({ method }) => [method.return, method.return_untrained].filter(Boolean));
    const range = extent(told.flatMap((summary) => [...summary.per_seed, ...summary.ci95]));
    return make("div", {}, make("h3", {}, task), table(`Results on ${task}`,
      ["run", "method", "untrained", "after training", "per seed", "mean options", "duration", "interactions", "pre-training", "seeds"],
      rows.map(({ run, method }) => resultRow(run, method, range)), { class: "results" }),
      range ? make("p", { class: "fine axis-note" }, `Scale of the column per seed: ${number(range[0])} to ${number(range[1])}; ○ untrained IQM, dots seeds, bar the 95 % interval, line the interquartile mean (IQM). Duration: ticks an option.`) : null);
  });
}

function resultRow(run, method, range) {
  const seeds = method.return ? method.return.per_seed.length : run.facts.seeds;
  const missing = method.uncounted.length ? ` + unknown of ${method.uncounted.join(", ")}` : "";
  const partial = run.facts.finished || method.evaluated ? null : make("span", { class: "badge partial" }, "not evaluated yet");
  return make("tr", { "data-stage": method.stage },
    make("th", { scope: "row" }, run.name, run.facts.finished ? null : make("span", { class: "badge partial" }, "partial")),
    cell([swatchOf(run, method.stage), method.label, partial].filter(Boolean)),
    cell(twoLines(method.return_untrained), { class: "n" }), cell(twoLines(method.return), { class: "n strong" }),
    cell(method.return ? strip(method, range, colourFor(run, method.stage)) : "–"),
    cell(twoLines(method.return_mean_option), { class: "n" }),
    cell(method.duration ? number(method.duration.iqm, 3) : "–", { class: "n" }),
    cell(count(method.ticks), { class: "n" }), cell((method.pretraining || !missing ? count(method.pretraining) : "") + missing, { class: "n" }),
    cell(String(seeds) + (method.return && method.return.iqm === null ? ", some stopped" : ""), { class: "n" }));
}

// The number, and its interval below it.
function twoLines(summary) {
  if (!summary || summary.iqm === null || summary.ci95[0] === null) return interval(summary);
  return [number(summary.iqm), make("small", {}, `${number(summary.ci95[0])} … ${number(summary.ci95[1])}`)];
}

function colourFor(run, stage) {
  const found = run.stages.find((own) => own.stage === stage);
  return `var(--c${(found ? found.colour : 0) % COLOURS})`;
}

function swatchOf(run, stage) {
  const found = run.stages.find((own) => own.stage === stage);
  const mark = swatch(found && found.dashed);
  mark.setAttribute("style", `--own:${colourFor(run, stage)}`);
  return mark;
}

function strip(method, range, colour) {
  const [width, height] = [170, 26];
  const toX = (value) => 8 + ((value - range[0]) / (range[1] - range[0] || 1)) * (width - 16);
  const { per_seed: seeds, iqm, ci95 } = method.return;
  const svg = draw("svg", { class: "strip", width, height, role: "img", style: `--own:${colour}`, "aria-label": `per seed: ${seeds.map((s) => number(s)).join(", ")}` });
  svg.append(draw("line", { class: "grid", x1: 4, x2: width - 4, y1: 13, y2: 13 }));
  if (ci95[0] !== null) svg.append(draw("rect", { class: "band", x: toX(ci95[0]), y: 7, width: Math.max(1, toX(ci95[1]) - toX(ci95[0])), height: 12, rx: 2 }));
  for (const seed of seeds) if (seed !== null) svg.append(draw("circle", { class: "dot", cx: toX(seed), cy: 13, r: 2.6 }));
  const before = method.return_untrained;
  if (before && before.iqm !== null) svg.append(draw("circle", { class: "ring", cx: toX(before.iqm), cy: 13, r: 4 }));
  if (iqm !== null) svg.append(draw("line", { class: "mean", x1: toX(iqm), x2: toX(iqm), y1: 4, y2: 22 }));
  return svg;
}

// ---- sweeps

function sweepFigures() {
  return data.sweeps.map((sweep) => {
    const columns = ["point", ...sweep.axes, "iqm", "low", "high", "untrained", "diverged", "seeds"];
    const body = make("tbody");
    const sorted = { by: "iqm", up: false };
    const show = () => body.replaceChildren(...[...sweep.table].sort(order).map((row) => make("tr", {}, columns.map((name) => cell(row[name] ?? "", { class: "n" })))));
    const order = (a, b) => {
      const [x, y] = [a[sorted.by], b[sorted.by]];
      const both = Number.isFinite(+x) && Number.isFinite(+y);
      return (sorted.up ? 1 : -1) * (both ? x - y : String(x).localeCompare(String(y)));
    };
    const heads = columns.map((name) => make("th", { scope: "col", "aria-sort": "none" }, make("button", {
      type: "button", class: "sort",
      click: () => {
        sorted.up = sorted.by === name ? !sorted.up : name !== "iqm";
        sorted.by = name;
        heads.forEach((head, i) => head.setAttribute("aria-sort", columns[i] === name ? (sorted.up ? "ascending" : "descending") : "none"));
        show();
      },
    }, name)));
    show();
    return make("div", { class: "sweep" }, make("h3", {}, `Sweep ${sweep.name}: ${sweep.points} points`),
      sweep.notes.map((note) => make("p", { class: "note" }, note)),
      make("div", { class: "wide", role: "region", tabindex: 0, "aria-label": `Table of sweep ${sweep.name}` },
        make("table", {}, make("thead", {}, make("tr", {}, heads)), body)));
  });
}

// ---- configs

function configTable() {
  const names = [...new Set(data.runs.flatMap((run) => Object.keys(run.config)))];
  const single = data.runs.length === 1;
  const rows = names.map((name) => {
    const values = data.runs.map((run) => (name in run.config ? words(run.config[name]) : "not there"));
    const compared = single && name in data.defaults ? [...values, words(data.defaults[name])] : values;
    const differs = new Set(compared).size > 1;
    return make("tr", { class: differs ? "differs" : null, "data-field": name }, make("th", { scope: "row" }, make("code", {}, name)),
      values.map((value) => cell(make("code", {}, value))));
  });
  const differing = rows.filter((row) => row.className === "differs").length;
  const wrap = table("Configs", ["field", ...data.runs.map((run) => run.name)], rows, { class: "config" });
  redraws.push(() => { wrap.classList.toggle("only", view.fields !== "all"); });
  const what = single ? "what differs from the defaults" : "what differs among the runs";
  return make("details", { open: true }, make("summary", {}, `${differing} of ${names.length} fields: ${what}`),
    toggle("show every field", "fields", "all", ""), wrap);
}
