// Forms send their fields to the API; parts of the page that are marked live are fetched again after events.
const csrf = document.querySelector('meta[name=csrf]')?.content ?? '';
const message = document.getElementById('message');
const connection = document.getElementById('connection');

function say(text, good = false) {
  message.textContent = text;
  message.classList.toggle('good', good);
  if (text && !good) message.scrollIntoView({block: 'nearest'});
}

export async function call(operation, body, patience) {
  const [method, path] = operation.split(/ (.*)/);
  const headers = {'X-CSRF-Token': csrf};
  const request = {method, headers, keepalive: body === undefined};
  if (patience) request.signal = AbortSignal.timeout(patience);
  if (body instanceof FormData) request.body = body;
  else if (body !== undefined) { headers['Content-Type'] = 'application/json'; request.body = JSON.stringify(body); }
  let answer;
  try { answer = await fetch(path, request); }
  catch { throw new Error('the service does not answer'); }
  if (answer.ok && (answer.headers.get('Content-Disposition') ?? '').startsWith('attachment')) {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(await answer.blob());
    link.download = answer.headers.get('Content-Disposition').match(/filename="([^"]*)"/)?.[1] ?? 'file';
    link.click();
    return {done: `saved as ${link.download}`};
  }
  const text = await answer.text();
  let content = {};
  try { content = JSON.parse(text); } catch { /* not JSON */ }
  if (answer.status === 401 && location.pathname !== '/login') {
    location.href = '/login?next=' + encodeURIComponent(location.pathname);
  }
  if (!answer.ok) throw new Error(content.error?.text ?? `the service answered ${answer.status}`);
  return content;
}

function fields(form) {
  const found = {};
  for (const each of form.elements) {
    if (!each.name || each.matches(':disabled') || each.type === 'file') continue;
    let value = each.value;
    if (each.dataset.list !== undefined) {  // boxes of one name are a list
      found[each.name] ??= [];
      if (each.checked) found[each.name].push(JSON.parse(value));
      continue;
    }
    if (each.dataset.words !== undefined) value = each.type === 'checkbox' ? String(each.checked) : value;  // as on the command line
    else if (each.type === 'checkbox') value = each.checked;
    else if (each.type === 'radio') { if (!each.checked) continue; }
    else if (value === '' && each.dataset.empty === 'omit') continue;
    else if (each.type === 'number') value = value === '' ? null : Number(value);
    else if (each.dataset.json !== undefined) value = JSON.parse(value);
    else if (each.dataset.pairs !== undefined) {
      const written = text => text !== '' && each.dataset.empty !== undefined && Number.isFinite(Number(text)) ? Number(text) : text;
      value = Object.fromEntries(value.split('\n').filter(l => l.includes('=')).map(l => l.split(/=(.*)/).slice(0, 2).map(s => s.trim())).map(([k, v]) => [k, written(v)]));
    } else if (each.dataset.lines !== undefined) value = value.split('\n').map(l => l.trim()).filter(l => l);
    // a.b names the key b of the object a, a.0 the first of the list a
    const parts = each.name.split('.');
    let at = found;
    parts.slice(0, -1).forEach((part, k) => { at = at[part] ??= /^[0-9]+$/.test(parts[k + 1]) ? [] : {}; });
    at[parts.at(-1)] = value;
  }
  return found;
}

function form_data(form) {
  const found = new FormData(form);
  // An empty field or file is left out.
  for (const [name, value] of [...found.entries()]) {
    if (value === '' || (value instanceof File && value.size === 0 && value.name === '')) found.delete(name);
  }
  return found;
}

// A table with a column `calibration` and others, as {calibration: {column: number}}.
function table_of(text) {
  const [head, ...rows] = text.trim().split(/\r?\n/).filter(l => !l.startsWith('#')).map(l => l.split(',').map(s => s.trim()));
  const at = head.indexOf('calibration');
  if (at < 0) throw new Error('the table has no column calibration');
  return Object.fromEntries(rows.map(row => [row[at], Object.fromEntries(head.map((n, k) => [n, Number.parseFloat(row[k])]).filter((_, k) => k !== at))]));
}

async function with_files(form, body) {
  for (const input of form.querySelectorAll('input[data-table]')) body[input.dataset.table] = table_of(await input.files[0].text());
  for (const input of form.querySelectorAll('input[data-input]:enabled')) (body.inputs ??= {})[input.dataset.input] = await input.files[0].text();
  for (const input of form.querySelectorAll('input[data-text]:enabled')) {
    const [group, key] = input.dataset.text.split('.');
    if (input.files.length) body[group][key] = await input.files[0].text();
  }
  for (const table of form.querySelectorAll('[data-rows]')) {  // rows filled in by hand, as the file would have them
    const rows = [...table.querySelectorAll('tbody tr')].map(row => [...row.querySelectorAll('input:enabled')]);
    const used = (rows[0] ?? []).map((_, k) => k).filter(k => rows.some(row => row[k].value !== ''));
    if (!used.length) continue;
    const lines = [used.map(k => rows[0][k].dataset.column), ...rows.map(row => used.map(k => row[k].value.replace(/[",]/g, ' ')))];
    body.texts[table.dataset.rows] = lines.map(line => line.join(',')).join('\n');
  }
  return body;
}

// What the page calls a calibration.
function called(key) { return [...document.querySelectorAll('a')].find(a => a.getAttribute('href').endsWith(`/${key}`))?.textContent ?? key; }

async function act(element, body) {
  if (element.dataset.ask && !confirm(element.dataset.ask)) return;
  const buttons = element.matches('form') ? element.querySelectorAll('button') : [element];
  const once = element.dataset.always === undefined;
  if (once) for (const b of buttons) b.disabled = true;
  say('');
  try {
    if (element.matches('form') && !(body instanceof FormData)) body = await with_files(element, body);
    const content = await call(element.dataset.api, body);
    if (element.dataset.api.endsWith('/check')) {
      const output = document.getElementById('tested');
      output.replaceChildren(...content.map(each => {
        const line = document.createElement('p');
        line.textContent = `${each.name}: ${each.error ?? (Object.entries(each.found).map(([k, v]) => `${k} ${v}`).join(', ') || 'works')}`;
        return line;
      }));
    }
    const output = element.querySelector('output');
    if (element.dataset.show && output) {
      output.replaceChildren('Shown this once: ');
      const code = document.createElement('code');
      code.textContent = content[element.dataset.show];
      output.append(code);
    }
    if (element.dataset.lines && output) {
      const lines = content[element.dataset.lines].map(([key, ...rest]) => [called(key), ...rest].join(': '));
      output.replaceChildren(...(lines.length ? lines : ['nothing']).map(each => {
        const line = document.createElement('p');
        line.textContent = each;
        return line;
      }));
    }
    if (element.dataset.done) {
      const name = content.name ?? content.session ?? '';
      location.href = element.dataset.done.replace('{name}', encodeURIComponent(name));
      return;
    }
    const failed = Object.entries(content.failed ?? {}).map(([what, why]) => `${what}: ${why}`);
    say(failed.length ? failed.join('; ') : content.done ?? 'done', !failed.length);
    if (element.matches('form') && element.dataset.keep === undefined) element.reset();
    refresh();
  } catch (error) {
    say(error.message);
  } finally {
    if (once) for (const b of buttons) b.disabled = false;
  }
}

document.addEventListener('submit', event => {
  const form = event.target;
  if (!form.dataset.api) return;
  event.preventDefault();
  let body;
  try { body = form.enctype === 'multipart/form-data' ? form_data(form) : fields(form); }
  catch (error) { say(`not JSON: ${error.message}`); return; }
  act(form, body);
});
document.addEventListener('click', event => {
  const button = event.target.closest('button[data-api]');
  if (!button) return;
  event.preventDefault();
  const body = button.dataset.body ? JSON.parse(button.dataset.body) : undefined;
  if (button.dataset.step) {
    const step = document.getElementById('step');
    if (!step.reportValidity()) return;
    body.position = Number(button.dataset.step) * Number(step.value);
  }
  act(button, body);
});

// Rows that are filled in by hand.
for (const table of document.querySelectorAll('[data-rows]')) {
  const rows = table.querySelector('tbody');
  table.addEventListener('click', event => {
    const button = event.target.closest('button');
    if (!button) return;
    event.preventDefault();
    if (button.dataset.remove !== undefined) button.closest('tr').remove();
    else {
      const before = [...rows.lastElementChild?.querySelectorAll('input') ?? []];
      rows.append(table.querySelector('template').content.cloneNode(true));
      [...rows.lastElementChild.querySelectorAll('input')].forEach((input, k) => {
        const now = document.querySelector(`[data-position="${input.dataset.column}"]`);
        if (input.dataset.column === 'name') input.value = `pose ${rows.children.length}`;
        else input.value = button.dataset.add === 'here' && now ? Number.parseFloat(now.textContent) : before[k]?.value ?? '';
      });
      rows.lastElementChild.querySelector('input').focus();
    }
    table.querySelector('table').hidden = !rows.children.length;
  });
}

// Fields that belong to what is chosen; those of other choices are neither shown nor sent.
for (const choice of document.querySelectorAll('[data-choose]')) {
  const choose = () => {
    for (const set of choice.form.querySelectorAll('fieldset[data-for]')) {
      set.disabled = !set.dataset.for.split(' ').includes(choice.value);
    }
  };
  choice.addEventListener('change', choose);
  choice.form.addEventListener('reset', () => setTimeout(choose));
  choose();
}

for (const drop of document.querySelectorAll('[data-drop]')) {
  const input = drop.querySelector('input[type=file]');
  const shown = drop.querySelector('output');
  const show = () => { shown.textContent = `${input.files.length} chosen`; };
  input.addEventListener('change', show);
  for (const kind of ['dragenter', 'dragover']) drop.addEventListener(kind, e => { e.preventDefault(); drop.classList.add('over'); });
  for (const kind of ['dragleave', 'drop']) drop.addEventListener(kind, e => { e.preventDefault(); drop.classList.remove('over'); });
  drop.addEventListener('drop', e => { input.files = e.dataTransfer.files; show(); });
}

// Live parts: replaced by those of the page as the server renders it now.
const PATIENCE = 15000, AGAIN = 2000;
let waiting = null, last = -Infinity, running = false;
export function refresh() {
  if (!document.querySelector('[data-live]')) return;
  if (waiting !== null) return;
  // Not by the clock, which may be set back.
  waiting = setTimeout(fetchAgain, Math.max(0, 400 - (performance.now() - last)));
}
async function fetchAgain() {
  waiting = null;
  if (running) { refresh(); return; }
  running = true;
  last = performance.now();
  try {
    const answer = await fetch(location.href, {headers: {'Accept': 'text/html'}, signal: AbortSignal.timeout(PATIENCE)});
    if (answer.redirected && new URL(answer.url).pathname === '/login') { location.href = answer.url; return; }
    if (answer.ok) renew(new DOMParser().parseFromString(await answer.text(), 'text/html'));
    else if (answer.status >= 500) setTimeout(refresh, AGAIN);
  } catch { setTimeout(refresh, AGAIN); }
  finally { running = false; }
}

// What somebody has entered already stays when the part of the page is replaced.
function boxed(e) { return e.type === 'checkbox' || e.type === 'radio'; }
function edited(e) {
  if (boxed(e)) return e.checked !== e.defaultChecked;
  return e.tagName === 'SELECT' ? e.selectedIndex > 0 || e.querySelector('[selected]') !== null : e.value !== e.defaultValue;
}
function field(e) { return [e.form?.dataset.api, e.form?.elements.instrument?.value, e.name, boxed(e) ? e.value : ''].join(' '); }

function renew(page) {
  for (const old of document.querySelectorAll('[data-live]')) {
    const fresh = page.getElementById(old.id);
    delete old.dataset.stale;
    if (!fresh || fresh.innerHTML === old.dataset.was) continue;
    const active = document.activeElement;
    if (old.contains(active) && active.matches('input:not([data-again]), select, textarea')) { old.dataset.stale = ''; continue; }
    const keyed = e => e.dataset.api ?? e.getAttribute('href') ?? e.id;
    const key = old.contains(active) ? keyed(active) : null;
    const open = [...old.querySelectorAll('details[open]')].map(d => d.id);
    const given = new Map([...old.querySelectorAll('input, select, textarea')].filter(edited).map(e => [field(e), e]));
    old.innerHTML = fresh.innerHTML;
    old.dataset.was = fresh.innerHTML;
    for (const id of open) document.getElementById(id)?.setAttribute('open', '');
    for (const e of old.querySelectorAll('input, select, textarea')) {
      const before = given.get(field(e));
      if (!before) continue;
      if (boxed(e)) e.checked = before.checked; else e.value = before.value;
    }
    if (key) [...old.querySelectorAll('button, a, input[data-again]')].find(e => keyed(e) === key)?.focus();
  }
}
// What was not replaced under the hands of somebody is, as soon as they leave it.
document.addEventListener('focusout', () => { if (document.querySelector('[data-stale]')) refresh(); });

// The stream of events. A connection may be dead without an end, after sleep or in another network: the service
// says something each ten seconds. A page that nobody sees needs none: browsers open few connections to a server.
const SILENCE = 25000, TICK = 5000;
let stream = null, heard = 0, ticked = Date.now();
function lost() {
  connection.textContent = 'The connection to the service is lost; what is shown may be old.';
  connection.hidden = false;
}
function listen() {
  stream?.close();
  heard = performance.now();
  const mine = stream = new EventSource('/api/1/events');
  const on = (kind, work) => mine.addEventListener(kind, event => { heard = performance.now(); work(event); });
  on('open', () => {
    connection.hidden = true;
    connection.textContent = '';
    refresh();  // also the first time: something may have changed since the page was rendered
  });
  on('error', () => {
    if (stream !== mine) return;
    lost();
    if (mine.readyState === EventSource.CLOSED) setTimeout(() => location.reload(), 3000);
  });
  on('change', refresh);
  on('reset', refresh);
  on('beat', () => {});
  on('end', () => location.reload());
}
if (document.querySelector('[data-live]') || document.querySelector('[data-bench]')) {
  if (!document.hidden) listen();
  document.addEventListener('visibilitychange', () => {
    if (document.hidden) { stream?.close(); stream = null; }
    else { listen(); refresh(); }
  });
  setInterval(() => {
    const jumped = Math.abs(Date.now() - ticked - TICK) > 10000;  // asleep, or a clock that was set
    ticked = Date.now();
    if (document.hidden || stream?.readyState === EventSource.CLOSED) return;
    if (jumped || performance.now() - heard > SILENCE) { lost(); listen(); }
  }, TICK);
}
for (const live of document.querySelectorAll('[data-live]')) live.dataset.was = live.innerHTML;

function edges(px) {
  if (px === null) return 'no edges';
  return px < 0.3 ? 'sharpest edges narrower than a pixel' : `sharpest edges ${px} px`;
}

function drawn(kind, attributes) {
  const found = document.createElementNS('http://www.w3.org/2000/svg', kind);
  for (const [name, value] of Object.entries(attributes)) found.setAttribute(name, value);
  return found;
}

// Exposure: how often each grey value occurs, saturated ones in the last bar. Roots, so that few are seen, too.
function exposure(place, counts) {
  const most = Math.max(...counts);
  place.replaceChildren(...counts.map((n, k) => {
    const height = 20 * Math.sqrt(n / most);
    return drawn('rect', {x: k, y: 20 - height, width: 0.9, height, ...(k === counts.length - 1 ? {class: 'last'} : {})});
  }));
}

// Focus: the widths of the sharpest edges in the last pictures; the line is the best of them.
const widths = [];
function focus(place, px) {
  widths.push(px);
  if (widths.length > 120) widths.shift();
  const known = widths.filter(each => each !== null);
  if (!known.length) { place.replaceChildren(); return null; }
  const best = Math.min(...known), top = Math.max(...known, 1.5 * best);
  const y = each => 19 - 18 * (each - 0.8 * best) / (top - 0.8 * best || 1);
  const points = widths.map((each, k) => each === null ? null : `${64 * k / 119},${y(each)}`).filter(each => each);
  place.replaceChildren(
    drawn('line', {x1: 0, x2: 64, y1: y(best), y2: y(best), class: 'best'}),
    drawn('polyline', {points: points.join(' ')}));
  return best;
}

// The live picture: fetched again and again while the page is visible.
const picture = document.querySelector('[data-bench]');
if (picture) {
  const image = picture.querySelector('img'), over = picture.querySelector('svg');
  const words = document.querySelector('[data-facts]');
  const aids = document.querySelector('[data-aids]'), best = document.querySelector('[data-best]');
  let shown = 0;
  const look = async () => {
    try {
      if (!document.hidden) {
        const facts = await call(`GET ${picture.dataset.bench}/picture`, undefined, PATIENCE);
        if (facts.error) words.textContent = facts.error;
        else if (facts.number && facts.number !== shown) {
          const answer = await fetch(`${picture.dataset.bench}/picture.jpg`, {signal: AbortSignal.timeout(PATIENCE)});
          if (answer.ok) {
            const url = URL.createObjectURL(await answer.blob());
            image.onload = () => URL.revokeObjectURL(url);
            image.src = url;
            image.hidden = false;
            shown = facts.number;
            over.setAttribute('viewBox', `-0.5 -0.5 ${facts.width} ${facts.height}`);
            over.replaceChildren(...(facts.points ?? []).map(([x, y]) => drawn('circle', {cx: x, cy: y, r: facts.width / 130})));
            words.textContent = `exposure ${facts.exposure}; ${edges(facts.edge_px)}; ${facts.points ? `${facts.points.length} points found` : 'its target is not known before a first session'}; ${facts.at.slice(11, 19)} UTC`;
            aids.hidden = false;
            exposure(aids.querySelector('[data-exposure]'), facts.histogram);
            const least = focus(aids.querySelector('[data-focus]'), facts.edge_px);
            best.textContent = least === null ? '' : `: best ${least < 0.3 ? 'below 0.3' : least} px`;
          }
        }
      }
    } catch (error) { words.textContent = error.message; }
    setTimeout(look, 250);
  };
  look();
}
