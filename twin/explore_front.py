"""The interactive front of a layout study: inline SVG and a few lines of script, no network.

Every trial is a point; a choice of axes, a click or the arrow keys choose what the panel beside it shows, and
an address that ends in ``#trial-12`` opens there. Without scripts the two objectives of the search are drawn.
"""

from __future__ import annotations

import html
import json
from typing import Any

import numpy as np

from twin.explore_results import Results, Trial
from twin.objectives import OBJECTIVES
from twin.report import BLUE, GREY, INK, RED, digits, plainly

_WIDTH, _HEIGHT = 620, 350
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 14, 14, 50

_STYLE = f"""\
.front {{ display: flex; gap: 1.2rem; align-items: flex-start; flex-wrap: wrap; }}
.front svg {{ width: {_WIDTH}px; max-width: 100%; height: auto; }}
.front .side {{ flex: 1 1 320px; min-width: 300px; font-size: .88rem; }}
#front select {{ font: inherit; font-size: .88rem; width: 23rem; }}
#front label {{ font-size: .88rem; margin-right: .8rem; color: #555; display: inline-block; }}
.front circle {{ cursor: pointer; }}
.front circle:focus-visible {{ outline: 2px solid {INK}; outline-offset: 2px; }}
.front h3 {{ margin: 0 0 .3rem; font-size: 1rem; }}
.front .side table {{ margin: .2rem 0 .6rem; width: 100%; }}
.front .side td {{ white-space: normal; }}
.front text {{ font: 12px system-ui, sans-serif; fill: {INK}; }}
.key {{ font-size: .85rem; color: #555; margin: .2rem 0 0 {_LEFT}px; }}
.key i {{ display: inline-block; width: .7rem; height: .7rem; border-radius: 50%; margin: 0 .3rem 0 .9rem; }}
.key i:first-child {{ margin-left: 0; }}
"""

_SCRIPT = """\
(function () {
  'use strict';
  var data = JSON.parse(document.getElementById('front-data').textContent);
  var svg = document.getElementById('front-svg'), side = document.getElementById('front-side');
  var x = document.getElementById('front-x'), y = document.getElementById('front-y');
  var NS = 'http://www.w3.org/2000/svg', box = data.box, chosen = data.first;
  function put(parent, tag, attributes, text) {
    var node = document.createElementNS(NS, tag);
    for (var name in attributes) node.setAttribute(name, attributes[name]);
    if (text !== undefined) node.textContent = text;
    parent.appendChild(node);
    return node;
  }
  function short(value) {
    if (value === undefined || value === null) return '\\u2014';
    if (typeof value !== 'number') return String(value);
    if (value === 0) return '0';
    var size = Math.abs(value);
    return size >= 1e5 || size < 1e-3 ? value.toExponential(2) : String(Number(value.toPrecision(3)));
  }
  function ticks(low, high) {
    var rough = (high - low) / 5, power = Math.pow(10, Math.floor(Math.log10(rough)));
    var step = power * [1, 2, 5, 10].filter(function (s) { return s * power >= rough; })[0];
    var found = [];
    for (var at = Math.ceil(low / step) * step; at <= high + step * 1e-9; at += step)
      found.push(Math.round(at / step) * step);
    return found;
  }
  function span(name) {
    var seen = data.trials.map(function (t) { return t.objectives[name]; })
      .filter(function (v) { return typeof v === 'number'; });
    var low = Math.min.apply(null, seen), high = Math.max.apply(null, seen);
    var room = (high - low || Math.abs(high) || 1) * 0.06;
    return [low - room, high + room];
  }
  function draw() {
    while (svg.firstChild) svg.removeChild(svg.firstChild);
    var h = span(x.value), v = span(y.value);
    function px(value) { return box.left + (value - h[0]) / (h[1] - h[0]) * box.wide; }
    function py(value) { return box.top + (v[1] - value) / (v[1] - v[0]) * box.high; }
    ticks(h[0], h[1]).forEach(function (at) {
      put(svg, 'line', {x1: px(at), x2: px(at), y1: box.top, y2: box.top + box.high, stroke: '#eee'});
      put(svg, 'text', {x: px(at), y: box.top + box.high + 17, 'text-anchor': 'middle'}, short(at));
    });
    ticks(v[0], v[1]).forEach(function (at) {
      put(svg, 'line', {x1: box.left, x2: box.left + box.wide, y1: py(at), y2: py(at), stroke: '#eee'});
      put(svg, 'text', {x: box.left - 7, y: py(at) + 4, 'text-anchor': 'end'}, short(at));
    });
    put(svg, 'text', {x: box.left + box.wide / 2, y: box.top + box.high + 38, 'text-anchor': 'middle'},
      data.words[x.value]);
    var label = put(svg, 'text', {transform: 'translate(14 ' + (box.top + box.high / 2) + ') rotate(-90)',
      'text-anchor': 'middle'}, data.words[y.value]), room = box.high + 2 * box.top;
    if (label.getComputedTextLength() > room) {
      label.setAttribute('textLength', room);
      label.setAttribute('lengthAdjust', 'spacingAndGlyphs');
    }
    var taken = [];
    var order = data.trials.slice().sort(function (a, b) { return a.rank - b.rank; });
    order.forEach(function (trial) {
      var a = trial.objectives[x.value], b = trial.objectives[y.value];
      if (typeof a !== 'number' || typeof b !== 'number') return;
      var dot = put(svg, 'circle', {cx: px(a), cy: py(b), r: trial.rank > 1 ? 7 : trial.rank ? 5 : 4,
        fill: data.colours[trial.kind], 'fill-opacity': trial.rank ? 1 : 0.45, tabindex: 0,
        role: 'button', 'aria-label': trial.name,
        stroke: trial.id === chosen ? data.ink : '#fff', 'stroke-width': trial.id === chosen ? 3 : 1});
      put(dot, 'title', {}, trial.name + ': ' + short(a) + ', ' + short(b));
      dot.addEventListener('click', function () { choose(trial.id); });
      dot.addEventListener('keydown', function (event) {
        if (event.key === 'Enter' || event.key === ' ') { event.preventDefault(); choose(trial.id); }
      });
      if (trial.rank < 2 && trial.id !== chosen) return;
      var left = px(a) > box.left + box.wide - 80, at = py(b) + 4;
      function meets(t) { return Math.abs(t[1] - at) < 13 && Math.abs(t[0] - px(a)) < 75; }
      for (var turn = 1; turn < 40 && (at < box.top + 9 || taken.some(meets)); turn += 1)
        at = py(b) + 4 + (turn % 2 ? -13 : 13) * Math.ceil(turn / 2);
      taken.push([px(a), at]);
      put(svg, 'text', {x: px(a) + (left ? -11 : 11), y: at, 'text-anchor': left ? 'end' : 'start'},
        trial.name);
    });
  }
  function table(head, rows) {
    var box = document.createElement('table'), body = document.createElement('tbody');
    var top = document.createElement('tr');
    head.forEach(function (cell) {
      var node = document.createElement('th');
      node.textContent = cell;
      top.appendChild(node);
    });
    body.appendChild(top);
    rows.forEach(function (row) {
      var line = document.createElement('tr');
      row.forEach(function (cell) {
        var node = document.createElement('td');
        node.textContent = cell;
        line.appendChild(node);
      });
      body.appendChild(line);
    });
    box.appendChild(body);
    return box;
  }
  function choose(id) {
    var trial = data.trials.filter(function (t) { return t.id === id; })[0];
    if (!trial) return;
    chosen = id;
    side.textContent = '';
    var title = document.createElement('h3');
    title.textContent = trial.name + (trial.rank === 1 ? ', on the front' : '');
    side.appendChild(title);
    var base = data.trials[0];
    function both(name, part) { return [short(trial[part][name]), short(base[part][name])]; }
    side.appendChild(table(['what it took', trial.name, 'baseline'],
      Object.keys(trial.values).map(function (name) { return [name].concat(both(name, 'values')); })));
    side.appendChild(table(['what it gives', trial.name, 'baseline'],
      data.shown.map(function (name) { return [data.words[name]].concat(both(name, 'objectives')); })));
    draw();
  }
  function fromAddress() { if (location.hash.length > 1) choose(location.hash.slice(1)); }
  x.addEventListener('change', draw);
  y.addEventListener('change', draw);
  document.addEventListener('keydown', function (event) {
    var step = {ArrowRight: 1, ArrowLeft: -1}[event.key];
    if (!step || !document.getElementById('front').contains(document.activeElement)) return;
    if (document.activeElement.tagName === 'SELECT') return;
    var ids = data.trials.slice().sort(function (a, b) {
      return (a.objectives[x.value] || 0) - (b.objectives[x.value] || 0);
    }).map(function (t) { return t.id; });
    choose(ids[(ids.indexOf(chosen) + step + ids.length) % ids.length]);
    event.preventDefault();
  });
  window.addEventListener('hashchange', fromAddress);
  choose(chosen);
  fromAddress();
}());
"""


def front(results: Results) -> str:
    """Return the markup of the front, escaped."""
    content = _content(results)
    names = content["shown"]
    first, *others = results.objectives
    second = others[0] if others else _second(first, names)
    # `</` would end the script: JSON knows the same character by its number
    data = json.dumps(plainly(content), ensure_ascii=True, allow_nan=False).replace("<", "\\u003c")
    key = "".join(
        f'<i style="background:{colour}"></i>{words}'
        for colour, words in (
            (RED, "baseline"),
            (INK, "winners"),
            (BLUE, "front (none beats them in everything)"),
            (GREY, "others"),
        )
    )
    return (
        f"<style>\n{_STYLE}</style>\n"
        '<div id="front"><p>'
        f"<label>across {_select('front-x', names, first)}</label>"
        f"<label>up {_select('front-y', names, second)}</label>"
        "</p>\n"
        f'<div class="front"><div><svg id="front-svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'tabindex="0" aria-label="trials over two objectives">{_still(results, first, second)}</svg>\n'
        f'<p class="key">{key}</p></div>\n'
        '<div class="side" id="front-side" aria-live="polite"></div></div></div>\n'
        f'<script type="application/json" id="front-data">{data}</script>\n<script>\n{_SCRIPT}</script>'
    )


def _content(results: Results) -> dict[str, Any]:
    """All that the script draws."""
    trials = [(results.baseline, "baseline", 2)]
    for place, trial in enumerate(results.trials):
        kind = "winner" if place in results.winners else "front" if place in results.front else "other"
        trials.append((trial, kind, {"winner": 2, "front": 1, "other": 0}[kind]))
    known = [name for name in OBJECTIVES if any(name in trial.objectives for trial, _, _ in trials)]
    best = results.best()
    return {
        "trials": [
            {
                "id": identity(trial),
                "name": trial.name,
                "kind": kind,
                "rank": rank,
                "values": trial.values,
                "objectives": {name: value for name, value in trial.objectives.items() if np.isfinite(value)},
            }
            for trial, kind, rank in trials
        ],
        "first": identity(best[0] if best else results.baseline),
        "shown": known,
        "words": {name: OBJECTIVES[name].text for name in known},
        "colours": {"baseline": RED, "winner": INK, "front": BLUE, "other": GREY},
        "ink": INK,
        "box": {
            "left": _LEFT,
            "top": _TOP,
            "wide": _WIDTH - _LEFT - _RIGHT,
            "high": _HEIGHT - _TOP - _BOTTOM,
        },
    }


def identity(trial: Trial) -> str:
    """What an address ends in to show a trial."""
    return trial.name.replace(" ", "-")


def _second(first: str, names: list[str]) -> str:
    return next((name for name in ("led_power_W", "bound_depth_mm", *names) if name != first), first)


def _select(identity: str, names: list[str], chosen: str) -> str:
    options = "".join(
        f'<option value="{html.escape(name, quote=True)}"{" selected" if name == chosen else ""}>'
        f"{html.escape(OBJECTIVES[name].text)}</option>"
        for name in names
    )
    return f'<select id="{identity}">{options}</select>'


def _still(results: Results, first: str, second: str) -> str:
    """The points without script: of print and of readers that run none."""
    points = [
        (trial.objectives[first], trial.objectives[second], colour)
        for trial, colour in [
            *((trial, GREY) for trial in results.trials),
            *((results.trials[place], BLUE) for place in results.front),
            (results.baseline, RED),
        ]
        if first in trial.objectives and second in trial.objectives
    ]
    if not points:
        return ""
    across, up = (np.array([point[axis] for point in points]) for axis in (0, 1))
    spans = [(float(v.min()), float(np.ptp(v)) or 1.0) for v in (across, up)]
    wide, high = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    drawn = []
    for a, b, colour in points:
        x = _LEFT + wide * (0.06 + 0.88 * (a - spans[0][0]) / spans[0][1])
        y = _TOP + high * (0.94 - 0.88 * (b - spans[1][0]) / spans[1][1])
        said = f"{digits(a)}, {digits(b)}"
        place = f'cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{colour}"'
        drawn.append(f"<circle {place}><title>{said}</title></circle>")
    return "".join(drawn)
