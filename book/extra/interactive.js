// What the interactive figures share: their data, native controls, drawing and numbers.
// Plain JavaScript, no library, works from a folder; only pages with such a figure load it.
"use strict";
const interactive = (() => {
  const SVG = "http://www.w3.org/2000/svg";

  // Empties a figure of the picture that stands in it without scripts. Returns it and its data.
  function figure(name) {
    const home = document.getElementById(name);
    const data = JSON.parse(home.querySelector("script").textContent);
    home.replaceChildren();
    return {home, data};
  }

  function element(parent, name, attributes = {}, text = "") {
    const node = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.textContent = text;
    parent.append(node);
    return node;
  }

  function shape(parent, name, attributes = {}, text = "") {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text) node.textContent = text;
    parent.append(node);
    return node;
  }

  // An empty picture of so many units.
  function picture(home, width, height) {
    return shape(home, "svg", {viewBox: `0 0 ${width} ${height}`, role: "img"});
  }

  // ------------------------------------------------------------------------------- controls

  function labelled(home, text, name, attributes) {
    const label = element(home, "label", {class: name});
    element(label, "span", {}, text);
    const input = element(label, name === "select" ? "select" : "input", attributes);
    return {label, input};
  }

  // `options` are pairs of a value and its text.
  function select(home, text, options, value) {
    const {input} = labelled(home, text, "select", {});
    for (const [key, words] of options) element(input, "option", {value: key}, words);
    input.value = value;
    return input;
  }

  // A slider, and beside it what `shown` makes of its number.
  function range(home, text, {value, shown, ...attributes}) {
    const {label, input} = labelled(home, text, "range", {type: "range", ...attributes});
    input.value = value;
    const words = element(label, "span");
    const show = () => {
      words.textContent = shown(+input.value);
      input.setAttribute("aria-valuetext", words.textContent);
    };
    input.addEventListener("input", show);
    show();
    return input;
  }

  function checkbox(home, text) {
    const {label, input} = labelled(home, text, "checkbox", {type: "checkbox"});
    label.prepend(input);
    return input;
  }

  function button(home, text, press) {
    const made = element(home, "button", {type: "button"}, text);
    made.addEventListener("click", press);
    return made;
  }

  // What has come out, in words, which screen readers say when it changes.
  function outcome(home) {
    return element(home, "output", {"aria-live": "polite"});
  }

  // `entries` are pairs of a class of marks and what they mean.
  function legend(home, entries) {
    const list = element(home, "ul", {class: "legend"});
    for (const [kind, text] of entries) {
      const item = element(list, "li");
      const sample = shape(item, "svg", {viewBox: "0 0 30 12", "aria-hidden": "true"});
      if (kind.startsWith("point")) shape(sample, "circle", {cx: 15, cy: 6, r: 5, class: kind});
      else shape(sample, "path", {d: "M1 6H29", class: kind});
      item.append(text);
    }
  }

  // ---------------------------------------------------------------------------------- axes

  // From [least, most] to [from, to], straight or logarithmic.
  function scale([least, most], [from, to], by = (value) => value) {
    return (value) => from + (to - from) * (by(value) - by(least)) / (by(most) - by(least));
  }

  // Numbers and lines of the grid below a field that reaches from `top` to `bottom`.
  function below(svg, x, ticks, [top, bottom], text, middle, digits = 0) {
    for (const tick of ticks) {
      shape(svg, "path", {d: `M${x(tick)} ${top}V${bottom}`, class: "grid"});
      shape(svg, "text", {x: x(tick), y: bottom + 17, "text-anchor": "middle"},
        number(tick, digits));
    }
    shape(svg, "text", {x: middle, y: bottom + 38, "text-anchor": "middle"}, text);
  }

  // The same to the left of a field that reaches from `left` to `right`.
  function beside(svg, y, ticks, [left, right], text, middle) {
    for (const tick of ticks) {
      shape(svg, "path", {d: `M${left} ${y(tick)}H${right}`, class: "grid"});
      shape(svg, "text", {x: left - 6, y: y(tick) + 5, "text-anchor": "end"}, number(tick));
    }
    const place = {x: -middle, y: 14, "text-anchor": "middle", transform: "rotate(-90)"};
    shape(svg, "text", place, text);
  }

  // With a minus sign, and no sign before zero.
  function number(value, digits = 0) {
    return value.toFixed(digits).replace(/^-(?=0\.?0*$)/, "").replace("-", "−");
  }

  return {
    figure, element, shape, picture, select, range, checkbox, button, outcome, legend, scale,
    below, beside, number,
  };
})();
