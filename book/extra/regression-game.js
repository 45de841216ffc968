// The game of two players with one spurious weight each, to be played with sliders.
// Used on the page "From IRM to IPO". Names follow ipo/causality/small_games.py.
"use strict";
(() => {
  const {shape, number} = interactive;
  const LIMIT = 3.2, ROUNDS = 6000, RATE = 0.1;
  const LEFT = 48, SIZE = 380, TOP = 8;
  const {home, data} = interactive.figure("regression-game");
  const ends = [-LIMIT, LIMIT];
  const x = interactive.scale(ends, [LEFT, LEFT + SIZE]);
  const y = interactive.scale(ends, [TOP + SIZE, TOP]);

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

  function draw(svg, rho, bound, path) {
    svg.replaceChildren();
    const whole = [-3, -2, -1, 0, 1, 2, 3], [right, bottom] = [LEFT + SIZE, TOP + SIZE];
    const text = "spurious weight of player";
    interactive.below(svg, x, whole, [TOP, bottom], `${text} 1`, LEFT + SIZE / 2);
    interactive.beside(svg, y, whole, [LEFT, right], `${text} 2`, TOP + SIZE / 2);
    shape(shape(svg, "clipPath", {id: "regression-game-clip"}), "rect",
      {x: LEFT, y: TOP, width: SIZE, height: SIZE});
    shape(svg, "rect", {x: LEFT, y: TOP, width: SIZE, height: SIZE, class: "frame"});
    const inside = shape(svg, "g", {"clip-path": "url(#regression-game-clip)"});
    rho.forEach((wish, d) => shape(inside, "line", {
      x1: x(ends[0]), y1: y(2 * wish - ends[0]), x2: x(ends[1]), y2: y(2 * wish - ends[1]),
      class: `player${d + 1}`}));
    if (Number.isFinite(bound)) {
      shape(inside, "rect", {x: x(-bound), y: y(bound), width: x(bound) - x(-bound),
        height: y(-bound) - y(bound), class: "bound"});
    }
    shape(inside, "polyline", {class: "path",
      points: path.map(([u, v]) => `${x(u).toFixed(1)},${y(v).toFixed(1)}`).join(" ")});
    shape(inside, "circle", {cx: x(0), cy: y(0), r: 4, class: "point-start"});
    const [u, v] = path[path.length - 1];
    shape(inside, "circle", {cx: x(u), cy: y(v), r: 7, class: "point-end"});
  }

  function words(rho, bound, [u, v]) {
    const ends = `The players end at ${number(u, 2)} and ${number(v, 2)}, their average at ` +
      `${number((u + v) / 2, 2)}. `;
    const drift = `That is only where ${ROUNDS} rounds end: they go on for ever, and there is no ` +
      "equilibrium. The average stays near that of pooled training. ";
    const theory = Number.isFinite(bound) ? `The theorem says ${number(vote(rho, bound), 2)}. `
      : rho[0] === rho[1] ? "Both want the same: this is an equilibrium. " : drift;
    return ends + theory +
      `Pooled least squares: ${number((rho[0] + rho[1]) / 2, 2)}; the invariant predictor: 0.`;
  }

  const pictures = interactive.element(home, "div", {class: "pictures"});
  const svg = interactive.picture(pictures, LEFT + SIZE + 12, TOP + SIZE + 44);
  interactive.legend(home, [
    ["player1", "player 1 is content"], ["player2", "player 2 is content"], ["bound", "bound"],
    ["path", "their path"], ["point-start", "start"], ["point-end", "end"],
  ]);
  const controls = interactive.element(home, "div", {class: "controls"});
  const slider = (text, least, most, value) => interactive.range(controls, text,
    {min: least, max: most, step: 0.05, value, shown: (chosen) => number(chosen, 2)});
  const wishes = data.wishes.map((wish, d) =>
    slider(`spurious coefficient of domain ${d + 1}`, -1, 1, wish));
  const bounded = slider("bound on each player", 0.1, 3, data.bound);
  const free = interactive.checkbox(controls, "no bound");
  const output = interactive.outcome(home);

  function update() {
    bounded.disabled = free.checked;
    const rho = wishes.map((input) => +input.value);
    const bound = free.checked ? Infinity : +bounded.value;
    const path = play(rho, bound);
    draw(svg, rho, bound, path);
    output.textContent = words(rho, bound, path[path.length - 1]);
    svg.setAttribute("aria-label", "Plane of the two players' spurious weights with their " +
      "best-response lines, the bound and the trajectory. " + output.textContent);
  }
  for (const input of [...wishes, bounded, free]) input.addEventListener("input", update);
  update();
})();
