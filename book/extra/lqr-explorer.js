// Costs of controllers in a new domain, and what their gains look at, by what they were trained
// with. Used on the page on LQR; data by experiments/interactive/lqr.py.
"use strict";
(() => {
  const {shape, number} = interactive;
  const {home, data} = interactive.figure("lqr-explorer");
  const chosen = {...data.first};
  const PARTS = [  // of the gain
    ["state", "columns of the state"], ["distractors", "columns of distractors"],
    ["inside", "felt in training"], ["outside", "not felt in training"],
  ];
  const WIDTH = 440, LEFT = 12, RIGHT = WIDTH - 20, TOP = 6, ROW = 42;

  const is = (wanted) => (cell) =>
    Object.entries(wanted).every(([key, value]) => String(cell[key]) === String(value));
  const find = (wanted) => data.cells.find(is(wanted));
  const all = (key) => [...new Set(data.cells.map((cell) => cell[key]))];
  const range = (values) => [Math.min(...values), Math.max(...values)];
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const sizes = () => ({num_domains: chosen.num_domains, dim_distractor: chosen.dim_distractor});
  const isReference = (cell) => cell.optimizer === "none";
  const name = (cell) => data.methods[cell.method].name +
    (isReference(cell) ? "" : `, ${data.optimizers[cell.optimizer]}`);

  const costs = range([data.oracle, ...data.cells.flatMap((cell) => cell.test)]);
  const x = interactive.scale([costs[0] / 1.05, costs[1] * 1.05], [LEFT, RIGHT], Math.log);
  const ticks = [10, 20, 30, 40, 50, 60, 80, 100, 150, 200, 300, 500, 1000]
    .filter((tick) => costs[0] / 1.05 < tick && tick < costs[1] * 1.05);
  const norms = range(data.cells.flatMap((cell) => PARTS.map(([part]) => cell[part])));
  const wide = interactive.scale([0, norms[1]], [LEFT, RIGHT]);

  const pictures = interactive.element(home, "div", {class: "pictures"});
  const rows = Math.max(...all("num_domains").flatMap((n) => all("dim_distractor").map((y) =>
    data.cells.filter(is({num_domains: n, dim_distractor: y})).length)));
  const bottom = TOP + rows * ROW;
  const left = interactive.picture(pictures, WIDTH, bottom + 46);
  const right = interactive.picture(pictures, WIDTH, bottom + 46);
  interactive.legend(home,
    [["oracle", "the oracle's cost"], ["closed", "minimum norm, closed form"]]);
  const controls = interactive.element(home, "div", {class: "controls"});
  const numeric = (key) => all(key).sort((a, b) => a - b).map((n) => [n, n]);
  const of = (names, keys) => Object.keys(names).filter((key) => keys.has(key))
    .map((key) => [key, names[key].name ?? names[key]]);
  const trained = data.cells.filter((cell) => !isReference(cell));
  const selects = Object.fromEntries([
    ["num_domains", "training domains", numeric("num_domains")],
    ["dim_distractor", "distractors", numeric("dim_distractor")],
    ["method", "method", of(data.methods, new Set(trained.map((cell) => cell.method)))],
    ["optimizer", "optimiser", of(data.optimizers, new Set(trained.map((c) => c.optimizer)))],
  ].map(([key, text, options]) =>
    [key, interactive.select(controls, text, options, chosen[key])]));
  const output = interactive.outcome(home);

  function drawCosts() {
    left.replaceChildren();
    interactive.below(left, x, ticks, [TOP, bottom], "cost in a new domain, every run", WIDTH / 2);
    shape(left, "path", {d: `M${x(data.oracle)} ${TOP}V${bottom}`, class: "oracle"});
    const cells = data.cells.filter(is(sizes())).sort((a, b) => mean(b.test) - mean(a.test));
    cells.forEach((cell, row) => {
      const y = TOP + row * ROW, color = data.methods[cell.method].color;
      const group = shape(left, "g", {class: is(chosen)(cell) ? "chosen" : "other"});
      shape(group, "rect", {x: 0, y, width: WIDTH, height: ROW - 2, rx: 4});
      const words = shape(group, "text", {x: x(mean(cell.test)), y: y + 17}, name(cell));
      words.setAttribute("text-anchor", x(mean(cell.test)) > WIDTH / 2 ? "end" : "start");
      for (const cost of cell.test) {
        shape(group, "circle", {cx: x(cost).toFixed(1), cy: y + 29, r: 5, style: `fill: ${color}`});
      }
    });
  }

  function drawGain(cell) {
    right.replaceChildren();
    const closed = find({...sizes(), method: "minimum_norm"}), row = (bottom - TOP) / PARTS.length;
    const step = norms[1] > 8 ? 2 : 1;
    const grid = [...Array(Math.floor(norms[1] / step) + 1).keys()].map((i) => i * step);
    interactive.below(right, wide, grid, [TOP, bottom], "norm of K, mean over runs", WIDTH / 2);
    PARTS.forEach(([part, text], i) => {
      const y = TOP + i * row;
      shape(right, "text", {x: LEFT + 4, y: y + 22}, `${text}: ${number(cell[part], 2)}`);
      shape(right, "rect", {x: LEFT, y: y + 30, width: wide(cell[part]) - LEFT, height: row - 46,
        class: part === "state" || part === "inside" ? "useful" : "harmful"});
      if (closed) {
        shape(right, "path", {d: `M${wide(closed[part])} ${y + 26}v${row - 38}`, class: "closed"});
      }
    });
  }

  function words(cell) {
    const sd = Math.sqrt(mean(cell.test.map((cost) => (cost - mean(cell.test)) ** 2)));
    return `Trained by ${name(cell)}, with ${cell.num_domains} domains and ` +
      `${cell.dim_distractor} distractors: cost ` +
      `${number(mean(cell.test), 1)} ± ${number(sd, 1)} in a new domain (mean ± standard ` +
      `deviation of ${cell.test.length} runs), ${number(cell.train, 1)} in the training domains; ` +
      `the oracle ${number(data.oracle, 1)}. Of K, ` +
      `${number(cell.distractors, 2)} looks at distractors, and ${number(cell.outside, 2)} lies ` +
      "where no training domain can feel it.";
  }

  // An option is there if the book has runs of it with the other three choices.
  function update() {
    for (const [key, input] of Object.entries(selects)) chosen[key] = input.value;
    for (const [key, input] of Object.entries(selects)) {
      for (const option of input.options) {
        option.disabled = !find({...chosen, [key]: option.value});
      }
    }
    drawCosts();
    drawGain(find(chosen));
    output.textContent = words(find(chosen));
    const means = data.cells.filter(is(sizes()))
      .map((cell) => `${name(cell)} ${number(mean(cell.test), 1)}`);
    left.setAttribute("aria-label", `Costs of all methods in a new domain: ${means.join("; ")}`);
    right.setAttribute("aria-label", "Norms of parts of K: " +
      PARTS.map(([part, text]) => `${text} ${number(find(chosen)[part], 2)}`).join("; "));
  }
  for (const input of Object.values(selects)) input.addEventListener("input", update);
  update();
})();
