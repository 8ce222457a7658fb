// Questions to the server. Everything that it says is put on the page as text, never as markup.

export async function ask(path) {
  const response = await fetch(path, { headers: { Accept: "application/json" } });
  const body = await response.json().catch(() => null);
  if (!response.ok) {
    throw new Error((body && body.error) || `${path}: ${response.status}`);
  }
  return body;
}

/** Have something changed; the server wants JSON from its own page. */
export async function tell(path, body) {
  const response = await fetch(path, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
  });
  const said = await response.json().catch(() => null);
  if (!response.ok) throw new Error((said && said.error) || `${path}: ${response.status}`);
  return said;
}

/** Calls back when something has changed, and when the connection comes or goes. */
export function listen(onChange, onConnection) {
  const events = new EventSource("/api/events");
  events.onmessage = onChange;
  events.onopen = () => onConnection(true);
  events.onerror = () => onConnection(false);
}

/** An element with properties and children; strings become text. */
export function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export function attributes(target, values) {
  for (const [name, value] of Object.entries(values)) {
    target.setAttribute(name, value);
  }
  return target;
}

// Okabe and Ito's colours, which colour-blind people tell apart; and a dash for the second round.
const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9", "#e69f00", "#444444"];

export function style_of(index) {
  return {
    color: COLOURS[index % COLOURS.length],
    dash: index < COLOURS.length ? null : "7 4",
  };
}

export function day(seconds) {
  return new Date(seconds * 1000).toISOString().slice(0, 10);
}

export function clock(seconds) {
  return new Date(seconds * 1000).toISOString().slice(11, 19);
}
