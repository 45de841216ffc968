// The game of two players with one spurious weight each, to be played with sliders.
// Plain JavaScript, no library, works from a folder. Used on the page "From IRM to IPO", where a
// static picture stands in its place without scripts. Names follow ipo/causality/small_games.py.
"use strict";
(() => {
  const LIMIT = 3.2, SIZE = 400, ROUNDS = 6000, RATE = 0.1;
  const home = document.getElementById("regression-game");
  if (!home) return;

  const CONTROLS = [
    {key: "rho1", text: "spurious coefficient of domain 1", min: -1, max: 1, value: 0.8},
    {key: "rho2", text: "spurious coefficient of domain 2", min: -1, max: 1, value: -0.4},
    {key: "bound", text: "bound on each player", min: 0.1, max: 3, value: 2},
  ];

  // One plain gradient step of each player in turn, as in play() with bounds.
  function play(rho, bound) {
    const w = [0, 0], path = [[0, 0]];
    for (let round = 0; round < ROUNDS; round++) {
      for (const d of [0, 1]) {
        w[d] += RATE * (rho[d] - (w[0] + w[1]) / 2);
        w[d] = Math.max(-bound, Math.min(bound, w[d]));
      }
      path.push([...w]);
    }
    return path;
  }

  // vote(): the median of the domains' wishes and the averages of players at their bounds.
  function vote(rho, bound) {
    return [...rho, -bound, 0, bound].sort((a, b) => a - b)[2];
  }

  const SVG = "http://www.w3.org/2000/svg";
  function add(parent, name, attributes, text) {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text) node.textContent = text;
    parent.append(node);
    return node;
  }
  const x = (u) => SIZE * (u + LIMIT) / (2 * LIMIT);
  const y = (v) => SIZE * (LIMIT - v) / (2 * LIMIT);

  function draw(svg, rho, bound, path) {
    svg.replaceChildren();
    const clip = add(add(svg, "clipPath", {id: "regression-game-clip"}), "rect",
      {x: 0, y: 0, width: SIZE, height: SIZE});
    clip.setAttribute("fill", "none");
    const inside = add(svg, "g", {"clip-path": "url(#regression-game-clip)"});
    add(inside, "rect", {x: 0.5, y: 0.5, width: SIZE - 1, height: SIZE - 1, class: "frame"});
    add(inside, "path", {d: `M0 ${y(0)}H${SIZE}M${x(0)} 0V${SIZE}`, class: "axis"});
    rho.forEach((wish, d) => add(inside, "line", {
      x1: x(-LIMIT), y1: y(2 * wish + LIMIT), x2: x(LIMIT), y2: y(2 * wish - LIMIT),
      class: `player${d + 1}`}));
    if (Number.isFinite(bound)) {
      add(inside, "rect", {x: x(-bound), y: y(bound), width: x(bound) - x(-bound),
        height: y(-bound) - y(bound), class: "bound"});
    }
    add(inside, "polyline", {class: "path",
      points: path.map(([u, v]) => `${x(u).toFixed(1)},${y(v).toFixed(1)}`).join(" ")});
    add(inside, "circle", {cx: x(0), cy: y(0), r: 4, class: "start"});
    const [u, v] = path[path.length - 1];
    add(inside, "circle", {cx: x(u), cy: y(v), r: 7, class: "end"});
    add(svg, "text", {x: SIZE / 2, y: SIZE + 24, "text-anchor": "middle"},
      "spurious weight of player 1");
    add(svg, "text", {x: -SIZE / 2, y: -10, "text-anchor": "middle", transform: "rotate(-90)"},
      "spurious weight of player 2");
  }

  function number(value) {
    return value.toFixed(2).replace("-0.00", "0.00").replace("-", "−");
  }

  const style = document.createElement("style");
  style.textContent = `
    /* In dark mode the theme puts outputs on a light card; this one has the page's own colours. */
    .cell_output .text_html:has(#regression-game) { background: transparent !important; }
    #regression-game { max-width: 30rem; margin: 1rem auto; color: var(--pst-color-text-base, #222); }
    #regression-game svg { width: 100%; height: auto; color: var(--pst-color-text-base, #222); }
    #regression-game text { fill: currentColor; font-size: 15px; }
    #regression-game .frame { fill: none; stroke: currentColor; opacity: 0.4; }
    #regression-game .axis { stroke: currentColor; opacity: 0.25; }
    #regression-game .player1 { stroke: #e8590c; stroke-width: 2.5; }
    #regression-game .player2 { stroke: #3b9ae1; stroke-width: 2.5; stroke-dasharray: 9 4; }
    #regression-game .bound { fill: none; stroke: currentColor; stroke-width: 2; }
    #regression-game .path { fill: none; stroke: currentColor; stroke-width: 2; }
    #regression-game .start { fill: currentColor; }
    #regression-game .end { fill: #12a37c; stroke: currentColor; }
    #regression-game label { display: grid; grid-template-columns: 1fr 3.5rem; margin-top: 0.4rem; }
    #regression-game label input[type=range] { grid-column: 1 / 3; width: 100%; }
    #regression-game label span:nth-child(2) { text-align: right; }
    #regression-game .switch { display: block; }
    #regression-game output { display: block; margin-top: 0.6rem; min-height: 6rem; }`;
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", `-34 -6 ${SIZE + 40} ${SIZE + 38}`);
  svg.setAttribute("role", "img");
  const output = document.createElement("output");
  output.setAttribute("aria-live", "polite");
  const inputs = {}, shown = {};
  home.replaceChildren(style, svg);
  for (const control of CONTROLS) {
    const label = document.createElement("label");
    const name = document.createElement("span");
    shown[control.key] = document.createElement("span");
    const input = document.createElement("input");
    Object.assign(input, {type: "range", min: control.min, max: control.max, step: 0.05});
    input.value = control.value;
    name.textContent = control.text;
    label.append(name, shown[control.key], input);
    inputs[control.key] = input;
    home.append(label);
  }
  const label = document.createElement("label");
  label.className = "switch";
  const free = document.createElement("input");
  free.type = "checkbox";
  label.append(free, " no bound");
  home.append(label, output);

  function update() {
    for (const key of Object.keys(inputs)) shown[key].textContent = number(+inputs[key].value);
    inputs.bound.disabled = free.checked;
    const rho = [+inputs.rho1.value, +inputs.rho2.value];
    const bound = free.checked ? Infinity : +inputs.bound.value;
    const path = play(rho, bound);
    draw(svg, rho, bound, path);
    const [u, v] = path[path.length - 1];
    const ends = `The players end at ${number(u)} and ${number(v)}, their average at ` +
      `${number((u + v) / 2)}. `;
    const theory = free.checked
      ? (rho[0] === rho[1] ? "Both want the same: this is an equilibrium. "
        : `That is only where ${ROUNDS} rounds end: they go on for ever, and there is no ` +
          "equilibrium. The average stays near that of pooled training. ")
      : `The theorem says ${number(vote(rho, bound))}. `;
    output.textContent = ends + theory +
      `Pooled least squares: ${number((rho[0] + rho[1]) / 2)}; the invariant predictor: 0.`;
    svg.setAttribute("aria-label", "Plane of the two players' spurious weights with their " +
      "best-response lines, the bound and the trajectory. " + output.textContent);
  }
  for (const input of [...Object.values(inputs), free]) input.addEventListener("input", update);
  update();
})();
