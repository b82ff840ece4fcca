# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A headless browser of the system, without a network: opens a page, acts on it, reads it."""

import html
import json
import os
import re
import shutil
import subprocess
import tempfile

import pytest

_NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
_DEADLINE = 120.0  # [s] on a machine that is busy
# No name is looked up, so nothing can be fetched; WebGL without a graphics card.
_OPTIONS = ('--headless', '--no-sandbox', '--disable-gpu', '--enable-unsafe-swiftshader',
            '--host-resolver-rules=MAP * ~NOTFOUND', '--window-size=1400,1200',
            '--enable-logging=stderr', '--no-first-run', '--disable-background-networking',
            '--disable-component-update', '--disable-sync', '--disable-quic')
# Runs before everything of the page: whatever goes wrong in it is kept.
_WATCH = """<script>
window.complaints = [];
window.addEventListener('error', event => window.complaints.push(String(event.message)));
window.addEventListener('unhandledrejection', event => window.complaints.push(
  String(event.reason)));
document.addEventListener('securitypolicyviolation', event => window.complaints.push(
  'would fetch ' + event.blockedURI));
for (const name of ['error', 'warn']) console[name] = (...words) => window.complaints.push(
  words.join(' '));
</script>"""
# Waits until the page is open, acts, and leaves what that returns in the page.
_ACT = """<script>
(async () => {{
  const wait = milliseconds => new Promise(done => setTimeout(done, milliseconds));
  while (!document.body.dataset.opened) await wait(20);
  let found;
  try {{ found = await (async () => {{ {script} }})(); }}
  catch (error) {{ window.complaints.push(String(error)); }}
  await wait(100);
  const made = document.createElement('pre');
  made.id = 'found-by-the-test';
  made.textContent = JSON.stringify([window.complaints, found === undefined ? null : found]);
  document.body.append(made);
  if (parent !== window) parent.postMessage(made.outerHTML, '*');
}})();
</script>"""
# One browser opens several pages sooner than several browsers.
_FRAMES = """<!DOCTYPE html><body>{frames}
<script>
const found = new Map(), frames = [...document.querySelectorAll('iframe')];
addEventListener('message', event => {{
  found.set(frames.findIndex(one => one.contentWindow === event.source), event.data);
  if (found.size === frames.length)
    document.body.innerHTML = frames.map((one, k) => found.get(k)).join('');
}});
</script>"""
_FRAME = '<iframe src="page{number}.html" width="1400" height="844"></iframe>'


def browser():
    """Return the browser's path; where none is installed skip the test, under CI fail it."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        lacking = pytest.fail if os.environ.get('CI') else pytest.skip
        lacking(f'no browser is installed here; expected one of {", ".join(_NAMES)}')
    return path


def opened(page, script):
    """Open a copy of a page, run a script in it, return what that returns and complaints."""
    return opened_together([page], script)[0]


def opened_together(pages, script):
    """Open copies of pages beside each other in one browser, see `opened`; return a list."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        frames = ''.join(_FRAME.format(number=k) for k in range(len(pages)))
        copies = {f'page{k}.html': _acting(page, script) for k, page in enumerate(pages)}
        for name, text in {**copies, 'frames.html': _FRAMES.format(frames=frames)}.items():
            with open(f'{folder}/{name}', 'w', encoding='utf-8') as file:
                file.write(text)
        shown = 'frames' if len(pages) > 1 else 'page0'
        ran = subprocess.run(
            [browser(), *_OPTIONS, f'--user-data-dir={folder}/profile',
             '--virtual-time-budget=30000', '--dump-dom', f'file://{folder}/{shown}.html'],
            capture_output=True, text=True, timeout=_DEADLINE)
    found = re.findall(r'<pre id="found-by-the-test">(.*?)</pre>', ran.stdout, re.DOTALL)
    assert len(found) == len(pages), f'{ran.stdout[-500:]}\n{ran.stderr[-2000:]}'
    return [tuple(reversed(json.loads(html.unescape(one)))) for one in found]


def _acting(page, script):
    """Return the text of a page that runs a script once it is open."""
    text = page.read_text(encoding='utf-8')
    assert text.count('<head>') == text.count('</body>\n</html>') == 1
    return text.replace('<head>', f'<head>{_WATCH}', 1).replace(
        '</body>\n</html>', f'{_ACT.format(script=script)}</body>\n</html>', 1)
