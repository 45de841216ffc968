// Sets the equations of pages: reads {page: [[TeX, is displayed], ...]} from standard input, writes
// {page: {equations: [HTML, ...], glyphs: HTML of the shapes that they share}} to standard output.

const folder = `${__dirname}/mathjax`;

global.MathJax = {
  loader: {
    paths: {mathjax: folder},
    require,
    load: ['core', 'input/tex-full', 'output/svg', 'adaptors/liteDOM'],
  },
  // A mistake ends the build, and is not shown on the page.
  tex: {packages: {'[-]': ['noundefined', 'noerrors']}, formatError: (_, error) => { throw error; }},
  svg: {fontCache: 'global'},
  startup: {typeset: false},
};

// What the parser of HTML does not need, and what only scripts would ask for.
const SUPERFLUOUS = / (data-(mml-node|c|mjx-texclass)|xmlns(:xlink)?)="[^"]*"/g;

function set([tex, display]) {
  const {adaptor} = MathJax.startup;
  let container;
  try {
    container = MathJax.tex2svg(tex, {display});
  } catch (error) {
    throw new Error(`${error.message}: ${tex}`);
  }
  const picture = adaptor.firstChild(container);
  adaptor.setAttribute(picture, 'aria-hidden', 'true');
  adaptor.removeAttribute(picture, 'role');
  const html = adaptor.outerHTML(container).replace(SUPERFLUOUS, '').replace(/xlink:href/g, 'href');
  // What screen readers say; nobody sees it.
  const spoken = `<mjx-assistive-mml>${MathJax.tex2mml(tex, {display})}</mjx-assistive-mml>`;
  return html.replace('</mjx-container>', `${spoken.replace(/\n\s*/g, '')}</mjx-container>`);
}

async function main() {
  await require(`${folder}/startup.js`);
  await MathJax.startup.promise;
  const {adaptor, output} = MathJax.startup;
  const pages = JSON.parse(require('fs').readFileSync(0, 'utf8'));
  const done = {};
  for (const [page, equations] of Object.entries(pages)) {
    output.fontCache.clearCache();
    done[page] = {
      equations: equations.map(set),
      glyphs: adaptor.outerHTML(output.fontCache.getCache()),
    };
  }
  process.stdout.write(JSON.stringify(done));
}

main().catch(error => {
  process.stderr.write(`${error.message ?? error}\n`);
  process.exit(1);
});
