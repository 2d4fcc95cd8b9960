// The sections, in order.
function header() {
  document.title = DATA.title;
  document.getElementById("title").textContent = DATA.title;
  const environments = new Set(DATA.groups.map((group) => group.environment)).size;
  const counts = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
  document.getElementById("summary").textContent = `${counts(DATA.runs.length, "run")} in `
    + `${counts(DATA.groups.length, "line")} (an algorithm with its settings, on an environment `
    + `with its demonstrations), ${counts(environments, "environment")}. Made ${DATA.made}.`;
  const notes = document.getElementById("notes");
  if (DATA.notes.length) {
    notes.append(el("div", { class: "callout", id: "remarks" },
      el("ul", {}, DATA.notes.map((note) => el("li", {}, note)))));
  }
  if (DATA.skipped.length) {
    const count = DATA.skipped.length;
    notes.append(el("details", { class: "callout", id: "skipped", ...(count < 6 && { open: "" }) },
      el("summary", {}, `${counts(count, "folder")} left out of all figures`), el("ul", {},
        DATA.skipped.map((own) => el("li", {}, el("code", {}, own.path), ": ", own.reason)))));
  }
}

function resultsSection() {
  section("overview", "Results", "Interquartile mean over seeds of the final evaluation, with 95 % "
    + "bootstrap intervals; \u201cafter\u201d is after all adaptation steps. The dashed mark, "
    + "and the number below it, is the demonstrations\u2019 return. A click on a heading sorts.", resultTable());
}

function curvesSection() {
  const state = { axis: "iterations", measure: "return", when: "after", each: true };
  const grid = el("div", { class: "grid", id: "curve-grid" });
  const show = () => {
    const form = formOf(state.measure);
    grid.replaceChildren();
    for (const problem of PROBLEMS) {
      const name = `${state.measure}/${state.when}`;
      const groups = DATA.groups.filter((group) => group.problems.includes(problem)
        && group.curves[state.axis][name]);
      if (!groups.length) continue;
      const figure = el("div", { class: "figure" }, el("h3", {}, problem));
      grid.append(figure);  // first: it must have its width
      const own = groups.find((group) => problemOf(group) === problem) || groups[0];
      const reference = own.demonstrated.train;
      figure.append(lineChart(groups.map((group) => ({
        label: group.label, color: colorOf(group.label), seeds: seedsText(group.seeds.length),
        ...group.curves[state.axis][name],
      })), {
        xWords: AXIS_WORDS[state.axis], form, each: state.each,
        axisForm: state.measure === "success" ? percent : short,
        ys: state.measure === "success" ? [-0.03, 1.03] : null,
        reference: state.measure === "return" && reference !== undefined && reference !== null
          ? { value: reference, name: "demonstrations" } : null,
      }));
    }
    for (const [place, make] of [...DRAWN]) if (grid.contains(place)) draw(place, make);
  };
  const set = (name) => (value) => { state[name] = value; show(); };
  section("curves", "Learning curves", "What the episodes of each meta-iteration achieve, on the "
    + "training tasks. Thick: interquartile mean over seeds; band: 95 % interval; thin: each seed. "
    + "Point at a curve to read it.",
    el("div", { class: "controls" },
      choices("axis", "against", Object.entries(AXIS_WORDS), state.axis, set("axis")),
      choices("measure", "show", [["return", "return"], ["success", "success"]], state.measure,
        set("measure")),
      choices("when", "", [["before", "before"], ["after", "after adaptation"]], state.when,
        set("when")),
      tick("each", "each seed", state.each, set("each"))), grid);
  show();
}

function adaptationSection() {
  const sources = [...new Set(DATA.groups.flatMap((group) => group.adaptation
    .map((own) => own.source)))];
  const state = { split: "test", measure: "return", source: sources[0] };
  const grid = el("div", { class: "grid", id: "adaptation-grid" });
  const show = () => {
    grid.replaceChildren();
    for (const problem of PROBLEMS) {
      const groups = DATA.groups.filter((group) => group.problems.includes(problem));
      const lines = groups.flatMap((group) => group.adaptation
        .filter((own) => own.split === state.split && own.source === state.source)
        .map((own) => {
          const cells = own.cells[state.measure];
          return { label: group.label, color: colorOf(group.label), x: own.steps,
            seeds: seedsText(cells[0].seeds), value: cells.map((cell) => cell.value),
            low: cells.map((cell) => cell.low), high: cells.map((cell) => cell.high), each: [] };
        }));
      if (!lines.length) continue;
      const figure = el("div", { class: "figure" }, el("h3", {}, problem));
      grid.append(figure);
      const most = Math.max(...lines.map((line) => line.x.length)) - 1;
      figure.append(lineChart(lines, { xWords: "adaptation steps", form: formOf(state.measure),
        points: true, whole: true, height: 240, xs: [-0.15, most + 0.15],
        axisForm: state.measure === "success" ? percent : short,
        ys: state.measure === "success" ? [-0.03, 1.03] : null }));
    }
    if (!grid.children.length) grid.append(el("p", { class: "quiet" }, "No run has this figure."));
    for (const [place, make] of [...DRAWN]) if (grid.contains(place)) draw(place, make);
  };
  const set = (name) => (value) => { state[name] = value; show(); };
  section("adaptation", "Adaptation", "After 0, 1, .. adaptation steps. More steps than a run was "
    + "trained for come from evaluations (emrld_jax.evaluate with adapt.num_steps=3).",
    el("div", { class: "controls" },
      choices("adaptation-split", "of", [["test", "held-out"], ["train", "training tasks"]],
        state.split, set("split")),
      choices("adaptation-measure", "show", [["return", "return"], ["success", "success"]],
        state.measure, set("measure")),
      list("adaptation-source", "from", sources.map((own) => [own, own]), set("source"))), grid);
  show();
}

function comparisonSection() {
  const state = { split: "test", measure: "return", problem: null };
  const place = el("div", {}), which = el("span", {});
  const found = () => DATA.comparisons.filter((own) => own.split === state.split
    && own.measure === state.measure);
  const nameOf = (own) => own.problems.length > 2 ? `all ${own.problems.length} that are shared`
    : own.problems.join(" + ");
  const fits = (own) => own.competitors.length > 0;
  const show = () => {
    const all = found().filter(fits), own = all.find((each) => nameOf(each) === state.problem)
      || all[0];
    place.replaceChildren();
    if (!own) { place.append(el("p", { class: "quiet" }, "Nothing to compare here.")); return; }
    const select = list("problem", "on", all.map((each) => [nameOf(each), nameOf(each)]),
      (value) => { state.problem = value; show(); });
    select.querySelector("select").value = nameOf(own);
    which.replaceChildren(select);
    if (own.problems.length > 2) {
      place.append(el("p", { class: "quiet small" }, `Over ${own.problems.join("; ")}.`));
    }
    const seeds = (each) => new Set(each.seeds).size > 1 || each.seeds.length === 1
      ? each.seeds.map(seedsText).join(" + ") : `${each.seeds.length} x ${seedsText(each.seeds[0])}`;
    const rows = own.competitors.map((each) => ({ ...each.score, label: each.label,
      color: colorOf(each.label), note: `(${seeds(each)})` }));
    const counts = Object.fromEntries(own.competitors.map((each) => [each.label, each.seeds
      .reduce((sum, count) => sum + count, 0)]));
    const grid = el("div", { class: "grid" });
    place.append(grid);
    const add = (title, about, make) => {
      const figure = el("div", { class: "figure" }, el("h3", {}, title),
        el("p", { class: "quiet small" }, about));
      grid.append(figure);
      figure.append(make());
    };
    const form = state.measure === "success" ? percent : (value) => value.toFixed(2);
    const references = Object.entries(own.references).map(([name, value]) =>
      `${name} ${value.toFixed(1)}`).join(", ");
    add("Interquartile mean", state.measure === "return" ? `Returns divided by a reference: the `
      + `best demonstrations\u2019 return (${references}).` : "Success rates.",
      () => intervalChart(rows, range([...rows.flatMap((row) => [row.value, row.low, row.high]),
        0, 1], 0.03), { form }));
    add("Performance profile", "Share of runs whose score is above tau.", () => lineChart(
      own.competitors.map((each) => ({ label: each.label, color: colorOf(each.label),
        seeds: seeds(each), x: DATA.thresholds, ...each.profile,
        each: [] })), { xWords: "tau", form: percent, axisForm: percent, ys: [-0.03, 1.03],
        height: 250 }));
    if (own.improvements.length) {
      add("Probability of improvement", "That a run of the first scores higher than one of the "
        + "second; a tie counts half.", () => intervalChart(own.improvements.map((each) => ({
        ...each, label: `${each.first} > ${each.second}`, color: colorOf(each.first),
        note: `(${counts[each.first]} and ${seedsText(counts[each.second])})` })), [0, 1],
        { form: percent, middle: 0.5 }));
    }
    for (const [node, make] of [...DRAWN]) if (grid.contains(node)) draw(node, make);
  };
  const set = (name) => (value) => { state[name] = value; show(); };
  section("comparison", "Comparison", "A run\u2019s score is its mean over tasks after "
    + "adaptation.", el("div", { class: "controls" },
      choices("comparison-split", "of", [["test", "held-out"], ["train", "training tasks"]],
        state.split, set("split")),
      choices("comparison-measure", "by", [["return", "return"], ["success", "success"]],
        state.measure, set("measure")), which), place);
  show();
}

function settingsSection() {
  const place = el("div", {}, settingsTable(true));
  const count = DATA.settings.filter((row) => row.differs).length;
  section("settings", "Settings", `${count} of ${DATA.settings.length} settings are not the same `
    + "in all lines; values other than the most frequent one are "
    + "highlighted.", el("div", { class: "controls" },
    tick("all-settings", "show those that are the same too", false,
      (all) => place.replaceChildren(settingsTable(!all)))), place);
}

function notesSection() {
  const points = [
    "A line\u2019s runs differ in their seed alone. A run\u2019s score is the mean over tasks and "
    + "episodes of its final evaluation. Single tasks are not counted as samples: those of a run "
    + "share its meta-policy.",
    "The interquartile mean leaves out a quarter of the scores, rounded down, at each end; of "
    + "fewer than 4 it is the mean.",
    `Intervals hold 95 % of ${DATA.resamples} bootstrap resamples, which draw runs with `
    + "replacement, each environment\u2019s by themselves. Of one run there is none. Of three "
    + "there are only ten different resamples: read them with care.",
    "Curves against environment steps or seconds are read off each seed\u2019s by straight lines, "
    + "over the part that all seeds have. Seconds are wall-clock time of meta-iterations "
    + "(compilation included; saving and evaluating not), and of all runs together that trained "
    + "side by side in one program.",
    "After Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, "
    + "NeurIPS 2021.",
  ];
  section("method", "How figures are computed", "", el("ul", { class: "small" },
    points.map((point) => el("li", {}, point))));
}

header();
resultsSection();
curvesSection();
pathsSection();
adaptationSection();
comparisonSection();
settingsSection();
section("runs", "Runs", "What was run, where and with what; a plus after a commit: files differed "
  + "from it. Links are relative to this page.", runTable(),
  el("h3", { style: "margin-top: 1.2rem" }, "How they were run"), howRun());
notesSection();
document.getElementById("nav").append(...SECTIONS.map(([id, title]) =>
  el("a", { href: `#${id}` }, title)));
