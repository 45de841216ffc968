// What policies of the coloured keys do, step by step, at any temperature. Used on the page on
// coloured keys; data by experiments/interactive/keys.py, which says what they are.
"use strict";
(() => {
  const {element, shape, number} = interactive;
  const {home, data} = interactive.figure("keys-explorer");
  const NUM_ACTIONS = data.actions.length, NUM_STATES = data.next.length;
  const HORIZON = data.goal_reward.length;
  const CELL = 72, SIZE = 5, GOAL = [3, 3];
  const DIRECTIONS = ["right", "down", "left", "up"], DOOR = ["open", "closed", "locked"];
  const PAINT = {red: "#e02020", green: "#1f9d3a", blue: "#2f6bff", purple: "#9030d0",
    yellow: "#d8b400", grey: "#8a8a8a"};

  // ------------------------------------------------------------------------------ policies

  function logPolicy(name, color) {
    const bytes = Uint8Array.from(atob(data.policies[name][data.colors.indexOf(color)]),
      (letter) => letter.charCodeAt(0));
    return new Int16Array(bytes.buffer);
  }

  // Probabilities of all actions in all states; at temperature 0 the most likely action is taken.
  function heated(name, color, temperature) {
    const log = logPolicy(name, color);
    return data.observation.map((seen) => {
      const scores = [...log.subarray(seen * NUM_ACTIONS, (seen + 1) * NUM_ACTIONS)];
      const top = Math.max(...scores);
      if (temperature === 0) return scores.map((_, a) => +(a === scores.indexOf(top)));
      const weights = scores.map((score) => Math.exp((score - top) / data.steps / temperature));
      const sum = weights.reduce((a, b) => a + b);
      return weights.map((weight) => weight / sum);
    });
  }

  // Expected return and chance of the goal, V_t(s), by the dynamic programme of the chapter.
  function values(policy) {
    const returns = [new Float64Array(NUM_STATES)], chances = [new Float64Array(NUM_STATES)];
    for (const reward of [...data.goal_reward].reverse()) {
      const laterReturn = returns[0], laterChance = chances[0];
      const [valued, reached] = [new Float64Array(NUM_STATES), new Float64Array(NUM_STATES)];
      for (let s = 0; s < NUM_STATES; s++) {
        for (let a = 0; a < NUM_ACTIONS; a++) {
          const after = data.next[s][a], p = policy[s][a];
          valued[s] += p * (after < 0 ? reward : laterReturn[after]);
          reached[s] += p * (after < 0 ? 1 : laterChance[after]);
        }
      }
      returns.unshift(valued);
      chances.unshift(reached);
    }
    return {returns, chances};
  }

  // ------------------------------------------------------------------------------- picture

  const at = ([column, row]) => `translate(${(column + 0.5) * CELL} ${(row + 0.5) * CELL})`;

  function draw() {
    const [column, row, direction, ...rest] = data.scenes[state];
    const [key, door, doorState] = [rest.slice(0, 2), rest.slice(2, 4), rest[4]];
    const paint = PAINT[color.value];
    svg.replaceChildren();
    for (let r = 0; r < SIZE; r++) {
      for (let c = 0; c < SIZE; c++) {
        const isEdge = [0, SIZE - 1].includes(r) || [0, SIZE - 1].includes(c);
        const isWall = isEdge || (c === door[0] && r !== door[1]);
        shape(svg, "rect", {x: c * CELL, y: r * CELL, width: CELL, height: CELL,
          class: isWall ? "wall" : "floor"});
      }
    }
    shape(svg, "rect", {x: -26, y: -26, width: 52, height: 52, transform: at(GOAL), class: "goal"});
    const word = {transform: at(GOAL), dy: 5, "text-anchor": "middle", class: "on-goal"};
    shape(svg, "text", word, "goal");
    const frame = {x: -30, y: -30, width: doorState ? 60 : 12, height: 60, transform: at(door)};
    shape(svg, "rect", {...frame, fill: doorState ? paint : "none", stroke: paint, class: "door"});
    if (doorState === 2) shape(svg, "circle", {r: 8, transform: at(door), class: "keyhole"});
    drawKey(key[0] < 0 ? [column, row] : key, key[0] < 0 ? 0.6 : 1, paint);
    shape(svg, "path", {d: "M-22 -20L26 0L-22 20L-12 0Z", class: "agent",
      transform: `${at([column, row])} rotate(${90 * direction})`});
    const where = key[0] < 0 ? "in hand" : `at column ${key[0]}, row ${key[1]}`;
    svg.setAttribute("aria-label", `Agent at column ${column}, row ${row}, looking ` +
      `${DIRECTIONS[direction]}; ${color.value} key ${where}; door ${DOOR[doorState]} at column ` +
      `${door[0]}, row ${door[1]}; goal at column ${GOAL[0]}, row ${GOAL[1]}.`);
  }

  // Beside the agent, if it has the key in hand.
  function drawKey(place, size, paint) {
    const shift = size < 1 ? "translate(22 -22)" : "";
    const group = shape(svg, "g", {transform: `${at(place)} ${shift} scale(${size})`, class: "key",
      stroke: paint});
    shape(group, "circle", {cx: 0, cy: -14, r: 9});
    shape(group, "path", {d: "M0 -5V24M0 14H11M0 23H11"});
  }

  // ------------------------------------------------------------------------------ controls

  let state, step, isOver, policy, value;
  const pictures = element(home, "div", {class: "pictures"});
  const svg = interactive.picture(pictures, SIZE * CELL, SIZE * CELL);
  const bars = element(pictures, "div", {class: "bars", role: "group",
    "aria-label": "Actions and their probabilities"});
  const actions = data.actions.map((name, a) => {
    const press = interactive.button(bars, "", () => act(a));
    return {name, bar: element(press, "span", {class: "bar"}), words: element(press, "span")};
  });
  const controls = element(home, "div", {class: "controls"});
  const pairs = (names) => names.map((name) => [name, name]);
  const color = interactive.select(controls, "key and door", pairs(data.colors), data.colors[0]);
  const names = Object.keys(data.policies);
  const who = interactive.select(controls, "policy", pairs(names), names[0]);
  const layout = interactive.select(controls, "layout",
    data.layouts.map((_, number) => [number, number]), 0);
  const temperature = interactive.range(controls, "temperature",
    {min: 0, max: 3, step: 0.25, value: 1, shown: (chosen) => number(chosen, 2)});
  const buttons = element(home, "div", {class: "buttons"});
  interactive.button(buttons, "Most likely action",
    () => act(policy[state].indexOf(Math.max(...policy[state]))));
  interactive.button(buttons, "Sampled action", () => act(sampled(policy[state])));
  interactive.button(buttons, "Start again", begin);
  const output = interactive.outcome(home);

  function sampled(probabilities) {
    let rest = Math.random();
    const found = probabilities.findIndex((p) => (rest -= p) < 0);
    return found < 0 ? NUM_ACTIONS - 1 : found;
  }

  function act(action) {
    if (isOver) return;
    const after = data.next[state][action];
    step += 1;
    if (after >= 0) state = after;
    isOver = after < 0 || step === HORIZON;
    if (isOver) finish(after < 0);
    else show();
  }

  function finish(reached) {
    output.textContent = reached
      ? `Goal reached in step ${step}: a return of ${number(data.goal_reward[step - 1], 3)}.`
      : `Time is over after ${step} steps: a return of 0.`;
  }

  function begin() {
    [state, step, isOver] = [data.layouts[layout.value], 0, false];
    show();
  }

  function show() {
    draw();
    actions.forEach(({bar, words, name}, a) => {
      bar.style.width = `${100 * policy[state][a]}%`;
      words.textContent = `${name} ${number(100 * policy[state][a], 1)} %`;
    });
    const all = data.start.reduce((sum, p, s) => sum + p * value.returns[0][s], 0);
    output.textContent = `Step ${step} of ${HORIZON}. From here this policy has an expected ` +
      `return of ${number(value.returns[step][state], 3)}, and reaches the goal with probability ` +
      `${number(value.chances[step][state], 3)}. Over all layouts its expected return is ` +
      `${number(all, 3)}.`;
  }

  function update() {
    policy = heated(who.value, color.value, +temperature.value);
    value = values(policy);
    if (!isOver) show();
  }
  layout.addEventListener("input", begin);
  for (const input of [color, who, temperature]) input.addEventListener("input", update);
  [state, step, isOver] = [data.layouts[0], 0, false];
  update();
})();
