// Forms send their fields to the API; parts of the page that are marked live are fetched again after events.
const csrf = document.querySelector('meta[name=csrf]')?.content ?? '';
const message = document.getElementById('message');
const connection = document.getElementById('connection');

function say(text, good = false) {
  message.textContent = text;
  message.classList.toggle('good', good);
  if (text && !good) message.scrollIntoView({block: 'nearest'});
}

export async function call(operation, body) {
  const [method, path] = operation.split(/ (.*)/);
  const headers = {'X-CSRF-Token': csrf};
  const request = {method, headers, keepalive: body === undefined};
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
    if (!each.name || each.disabled || each.type === 'file') continue;
    let value = each.value;
    if (each.type === 'checkbox') value = each.checked;
    else if (each.type === 'radio') { if (!each.checked) continue; }
    else if (value === '' && each.dataset.empty === 'omit') continue;
    else if (each.type === 'number') value = value === '' ? null : Number(value);
    else if (each.dataset.json !== undefined) value = JSON.parse(value);
    else if (each.dataset.pairs !== undefined) {
      value = Object.fromEntries(value.split('\n').filter(l => l.includes('=')).map(l => l.split(/=(.*)/).slice(0, 2).map(s => s.trim())));
    }
    // a.b names the key b of the object a
    const parts = each.name.split('.');
    let at = found;
    for (const part of parts.slice(0, -1)) at = at[part] ??= {};
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

async function with_files(form, body) {
  for (const input of form.querySelectorAll('input[data-inputs]')) {
    body[input.dataset.inputs] = {};
    for (const file of input.files) body[input.dataset.inputs][file.name] = await file.text();
  }
  return body;
}

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
    if (element.dataset.done) {
      const name = content.name ?? content.session ?? '';
      location.href = element.dataset.done.replace('{name}', encodeURIComponent(name));
      return;
    }
    say(content.done ?? 'done', true);
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
  act(button, button.dataset.body ? JSON.parse(button.dataset.body) : undefined);
});

// Fields that belong to what is chosen; those of other choices are neither shown nor sent.
for (const choice of document.querySelectorAll('[data-choose]')) {
  const choose = () => {
    for (const set of choice.form.querySelectorAll('fieldset[data-for]')) {
      set.disabled = !set.dataset.for.split(' ').includes(choice.value);
    }
  };
  choice.addEventListener('change', choose);
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
let waiting = null, last = 0, running = false;
export function refresh() {
  if (!document.querySelector('[data-live]')) return;
  if (waiting !== null) return;
  waiting = setTimeout(fetchAgain, Math.max(0, 400 - (Date.now() - last)));
}
async function fetchAgain() {
  waiting = null;
  if (running) { refresh(); return; }
  running = true;
  last = Date.now();
  try {
    const answer = await fetch(location.href, {headers: {'Accept': 'text/html'}});
    if (answer.redirected && new URL(answer.url).pathname === '/login') { location.href = answer.url; return; }
    if (!answer.ok) return;
    const page = new DOMParser().parseFromString(await answer.text(), 'text/html');
    for (const old of document.querySelectorAll('[data-live]')) {
      const fresh = page.getElementById(old.id);
      if (!fresh || fresh.innerHTML === old.dataset.was) continue;
      const active = document.activeElement;
      if (old.contains(active) && active.matches('input, select, textarea')) { old.dataset.stale = ''; continue; }
      const key = old.contains(active) ? active.dataset.api ?? active.getAttribute('href') : null;
      const open = [...old.querySelectorAll('details[open]')].map(d => d.id);
      old.innerHTML = fresh.innerHTML;
      old.dataset.was = fresh.innerHTML;
      for (const id of open) document.getElementById(id)?.setAttribute('open', '');
      if (key) [...old.querySelectorAll('button, a')].find(e => (e.dataset.api ?? e.getAttribute('href')) === key)?.focus();
    }
    document.dispatchEvent(new CustomEvent('refreshed'));
  } catch { /* the stream says when the service is back */ }
  finally { running = false; }
}

if (document.querySelector('[data-live]') || document.querySelector('[data-bench]')) {
  const stream = new EventSource('/api/1/events');
  stream.addEventListener('open', () => {
    connection.hidden = true;
    connection.textContent = '';
    refresh();  // also the first time: something may have changed since the page was rendered
  });
  stream.addEventListener('error', () => {
    connection.textContent = 'The connection to the service is lost; what is shown may be old.';
    connection.hidden = false;
    if (stream.readyState === EventSource.CLOSED) setTimeout(() => location.reload(), 3000);
  });
  stream.addEventListener('change', event => {
    refresh();
    document.dispatchEvent(new CustomEvent('service-event', {detail: JSON.parse(event.data)}));
  });
  stream.addEventListener('reset', refresh);
  stream.addEventListener('end', () => location.reload());
  document.addEventListener('visibilitychange', () => { if (!document.hidden) refresh(); });
}
for (const live of document.querySelectorAll('[data-live]')) live.dataset.was = live.innerHTML;

function edges(px) {
  if (px === null) return 'no edges';
  return px < 0.3 ? 'sharpest edges narrower than a pixel' : `sharpest edges ${px} px`;
}

// The live picture: fetched again and again while the page is visible.
const picture = document.querySelector('[data-bench]');
if (picture) {
  const image = picture.querySelector('img'), over = picture.querySelector('svg');
  const words = document.querySelector('[data-facts]');
  let shown = 0;
  const look = async () => {
    try {
      if (!document.hidden) {
        const facts = await call(`GET ${picture.dataset.bench}/picture`);
        if (facts.error) words.textContent = facts.error;
        else if (facts.number && facts.number !== shown) {
          const answer = await fetch(`${picture.dataset.bench}/picture.jpg`);
          if (answer.ok) {
            const url = URL.createObjectURL(await answer.blob());
            image.onload = () => URL.revokeObjectURL(url);
            image.src = url;
            image.hidden = false;
            shown = facts.number;
            over.setAttribute('viewBox', `-0.5 -0.5 ${facts.width} ${facts.height}`);
            over.replaceChildren(...facts.points.map(([x, y]) => {
              const circle = document.createElementNS('http://www.w3.org/2000/svg', 'circle');
              circle.setAttribute('cx', x);
              circle.setAttribute('cy', y);
              circle.setAttribute('r', facts.width / 130);
              return circle;
            }));
            words.textContent = `exposure ${facts.exposure}; ${edges(facts.edge_px)}; ${facts.points.length} points found; ${facts.at.slice(11, 19)} UTC`;
          }
        }
      }
    } catch (error) { words.textContent = error.message; }
    setTimeout(look, 250);
  };
  look();
}
