// The page, from top to bottom.

// Colours count the policies of each task, so that those in one chart differ; a flat policy's line is dashed.
function assignColours() {
  const next = {};
  const colour = (i) => `var(--c${i % 8})`; // --c0 ... --c7 in page.css
  for (const { stages } of data.runs) {
    const options = stages.find((stage) => stage.stage === "train");
    const policies = stages.filter((stage) => stage !== options && stage.stage !== "learn");
    for (const stage of [options, ...policies].filter(Boolean)) {
      next[stage.task] = (next[stage.task] ?? -1) + 1;
      stage.colour = colour(next[stage.task]);
      stage.dashed = stage !== options;
    }
    // Learning options is in no chart with training over them.
    for (const stage of stages) stage.colour ??= options?.colour ?? colour(0);
  }
}

function heading() {
  const tasks = unique(data.runs.flatMap((run) => run.facts.tasks));
  const partial = data.runs.filter((run) => !run.facts.finished).length;
  const links = [...document.querySelectorAll("main section")].map((own) => make("a", {
    href: "#" + own.id,
    click: (event) => { // the address holds the view, not the place
      event.preventDefault();
      own.scrollIntoView();
      own.querySelector("h2").focus();
    },
  }, own.querySelector("h2").textContent));
  fill(document.getElementById("top"), {}, [
    make("h1", {}, "taic_jax ", make("span", {}, tasks.join(", "))),
    make("p", {}, `${data.runs.length} ${data.runs.length === 1 ? "run" : "runs"}${partial ? `, ${partial} of them partial` : ""}; written ${data.made}`),
    notes(data.notes), make("nav", { "aria-label": "Sections" }, links)]);
}

const gallery = (id, title, figures) => figures.length > 0 && section(id, title, make("div", { class: "charts small" }, figures));

function durationFigure(run, { label, share, of }) {
  const [width, height] = [320, 190];
  const mean = share.reduce((sum, value, i) => sum + value * (i + 1), 0);
  const frame = frameOf(width, height, [0.5, share.length + 0.5], [0, Math.max(...share)], false, { left: 52, right: 8, top: 14, bottom: 38 });
  const texts = share.map((value, i) => `${i + 1}: ${percent(value, 3)}`);
  const bars = share.map((value, i) => draw("rect", {
    class: "bar", x: frame.toX(i + 0.6), y: frame.toY(value), width: frame.toX(1.8) - frame.toX(1), height: frame.bottom - frame.toY(value),
  }, draw("title", {}, `${i + 1} ticks: ${percent(value, 3)}`)));
  const every = Math.ceil(share.length / 12);
  const numbers = share.map((_, i) => [i + 1, String(i + 1)]).filter((_, i) => i % every === 0);
  return figure([make("b", {}, run.name), ` ${label}, mean ${number(mean, 3)}`], {},
    draw("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `Share of options by ticks: ${texts.join(", ")}` },
      axes(frame, numbers, ticks(frame.y, 3, (value) => percent(value, 3)), "ticks an option took"), bars),
    make("p", { class: "fine" }, `All seeds, ${of}.`));
}

// A moving picture has a pause button, and pauses itself for readers with reduced motion.
function videoFigure(run) {
  const image = make("img", { src: run.video, width: 320, height: 240, alt: `Video: the first seed's policy over options in ${run.name}, on ${run.facts.task}` });
  const still = make("canvas", { width: 320, height: 240, role: "img", "aria-label": image.alt + ", its first frame" });
  const button = make("button", { type: "button", click: () => show(still.hidden) });
  const show = (pause) => {
    if (pause) still.getContext("2d").drawImage(image, 0, 0, still.width, still.height);
    [still.hidden, image.hidden] = [!pause, pause];
    button.textContent = pause ? "Play" : "Pause";
  };
  show(false);
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) image.addEventListener("load", () => show(true), { once: true });
  return figure([make("b", {}, run.name), " ", button], { class: "chart video" }, image, still);
}

readAddress();
assignColours();
document.getElementById("main").replaceChildren(...[
  data.runs.some((run) => run.methods.length) && section("results", "Results", make("p", { class: "lead" }, "Returns of the policy as it explores and of its mean options: interquartile mean over seeds (95 % bootstrap interval). Interactions are per seed."), resultTables()),
  curveSection(),
  gallery("durations", "Durations of options", data.runs.flatMap((run) => run.histograms.map((histogram) => durationFigure(run, histogram)))),
  measureSection(),
  optionSection(),
  data.sweeps.length > 0 && section("sweeps", "Sweeps", data.sweeps.map(sweepTable)),
  gallery("videos", "Videos", data.runs.filter((run) => run.video).map(videoFigure)),
  section("runs", "What was run", factsTable(), versionsTable()),
  section("configs", "Configs", configTable()),
].filter(Boolean));
heading();
redraw();
window.addEventListener("hashchange", () => { readAddress(); redraw(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
document.body.dataset.ready = "true";
