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
# No window of a browser is as narrow as a phone; a frame in it is.
_FRAME = """<!DOCTYPE html><body><iframe src="page.html" width="{width}" height="844"></iframe>
<script>addEventListener('message', event => document.body.innerHTML = event.data);</script>"""


def browser():
    """Return the browser's path; where none is installed skip the test, under CI fail it."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        lacking = pytest.fail if os.environ.get('CI') else pytest.skip
        lacking(f'no browser is installed here; expected one of {", ".join(_NAMES)}')
    return path


def opened(page, script, width=0):
    """
    Open a copy of a page, run a script in it, return what that returns and complaints.

    width : of a frame that the page is in, in pixels; 0: it is as wide as the window
    """
    text = page.read_text(encoding='utf-8')
    assert text.count('<head>') == text.count('</body>\n</html>') == 1
    text = text.replace('<head>', f'<head>{_WATCH}', 1).replace(
        '</body>\n</html>', f'{_ACT.format(script=script)}</body>\n</html>', 1)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for name, content in ('page', text), ('frame', _FRAME.format(width=width)):
            with open(f'{folder}/{name}.html', 'w', encoding='utf-8') as file:
                file.write(content)
        shown = 'frame' if width else 'page'
        ran = subprocess.run(
            [browser(), *_OPTIONS, f'--user-data-dir={folder}/profile',
             '--virtual-time-budget=30000', '--dump-dom', f'file://{folder}/{shown}.html'],
            capture_output=True, text=True, timeout=_DEADLINE)
    found = re.search(r'<pre id="found-by-the-test">(.*?)</pre>', ran.stdout, re.DOTALL)
    assert found, f'{ran.stdout[-500:]}\n{ran.stderr[-2000:]}'
    complaints, value = json.loads(html.unescape(found[1]))
    return value, complaints
