"""The page's looks, as one style sheet. Rules reach viser's controls by what stands before them (`markup.marker`)."""

_CSS = """
:root, [data-mantine-color-scheme="dark"] {
  --mantine-color-body: #181c22; --mantine-color-dark-9: #101318; --mantine-color-dark-8: #14171c;
  --mantine-color-dark-7: #181c22; --mantine-color-dark-6: #21262e; --mantine-color-dark-5: #2b313b;
  --mantine-color-dark-4: #353c48; --mantine-color-dark-3: #4b5464; --mantine-color-dark-2: #8b95a5;
  --mantine-color-dark-1: #aeb6c2; --mantine-color-dark-0: #d4d9e1;
  --ug-line: #2e3540; --ug-raised: #21262e; --ug-text: #d9dee6; --ug-dim: #939dac; --ug-accent: #339af0; --ug-amber: #e8a33d;
}
canvas[data-engine] { background: radial-gradient(120% 90% at 50% 38%, #262c36 0%, #181c22 55%, #101317 100%); }
button:has(> span svg.tabler-icon-adjustments), button:has(svg.tabler-icon-adjustments) { display: none !important; }
div:has(> i.ug-hidden-below) ~ div { display: none !important; }
div:has(> i[class^="ug-"]) { height: 0; }

/* labels and inputs of viser */
div:has(> p > label[for]) { width: 42% !important; padding-right: 8px !important; }
div:has(> p > label[for]) > p { letter-spacing: normal !important; font-size: 12.5px !important; line-height: 1.25 !important; overflow-wrap: normal !important; color: #b4bcc8 !important; font-weight: 400 !important; }
div:has(> div > p > label[for]) { width: 100%; }
div:has(> p > label[for]) + div { min-width: 0; }
input, textarea { font-variant-numeric: tabular-nums; }
.mantine-Input-input { background: #12151a; border-color: var(--ug-line); }
div:has(> i.ug-drafted) + div .mantine-Input-input { border-color: var(--ug-amber) !important; box-shadow: 0 0 0 1px #e8a33d55; }
div:has(> i.ug-drafted) + div p { color: var(--ug-amber) !important; }
div:has(> i.ug-edited) + div .mantine-Input-input { border-left: 3px solid var(--ug-amber) !important; }
div:has(> i.ug-edited) + div p { color: #f0c274 !important; }
div:has(> i.ug-wrong) + div .mantine-Input-input { border-color: #e25555 !important; }
.ug-setting-note { font-size: 11px; color: var(--ug-amber); margin: -4px 10px 6px calc(42% + 6px); line-height: 1.3; }
.ug-setting-note.ug-between { display: flex; justify-content: space-between; margin-top: 0; min-height: 15px; } .ug-setting-note.ug-examples { color: var(--ug-dim); } .ug-setting-note .ug-failure { color: #ff8a8a; }

/* rows of buttons */
div:has(> i.ug-primary) + div button { height: 38px !important; font-size: 15px; font-weight: 600; }
div:has(> i.ug-row3) + div, div:has(> i.ug-row3) + div + div, div:has(> i.ug-row3) + div + div + div { display: inline-block; width: calc((100% - 36px) / 3); margin-inline: 10px 0 !important; }
div:has(> i.ug-row3) + div + div, div:has(> i.ug-row3) + div + div + div { margin-left: 8px !important; }
div:has(> i.ug-boxes) + div > div > div:has(> p > label[for]), div:has(> i.ug-boxes) + div + div > div > div:has(> p > label[for]), div:has(> i.ug-boxes) + div + div + div > div > div:has(> p > label[for]) { width: auto !important; }
div:has(> i.ug-row3) ~ div button { padding-inline: 4px; }
div:has(> i.ug-row2) + div:has(input, button), div:has(> i.ug-row2) + div:has(input, button) + div:has(input, button) { display: inline-block; width: calc((100% - 30px) / 2); margin-inline: 10px 0 !important; }
.mantine-Button-root[data-disabled] { background: #262c35 !important; color: #697484 !important; }

[style*="height: 2.75em"] { height: 2.25em !important; }

/* text */
.ug-title, .ug-subtitle { white-space: nowrap; overflow: hidden; text-overflow: ellipsis; }
.ug-click { cursor: pointer; }
.ug-link { color: #7db4ff; font-size: 12px; margin-left: 10px; text-decoration: none; white-space: nowrap; }
.ug-link:hover, .ug-tool:hover, .ug-back:hover { color: #b9d6ff; }
.ug-note { color: var(--ug-dim); font-size: 11.5px; }
.ug-doc { color: var(--ug-dim); font-size: 12px; line-height: 1.35; margin: 3px 0 0; }
.ug-text { padding: 2px 12px 8px; font-size: 13px; line-height: 1.4; color: var(--ug-text); }
.ug-text.ug-doc { color: var(--ug-dim); font-size: 12px; }
.ug-download { display: block; text-align: center; color: #dce9ff; background: #24456f; border-radius: 3px; padding: 7px; text-decoration: none; font-weight: 500; } .ug-download:hover { background: #2d568a; } .ug-download:focus-visible { outline: 2px solid #7db4ff; outline-offset: 1px; }
.ug-heading { margin: 8px 12px 4px; font-size: 12.5px; font-weight: 600; color: #c3cad5; display: flex; justify-content: space-between; align-items: baseline; }
.ug-heading .ug-note { font-weight: 400; }
.ug-empty { margin: 14px 12px; padding: 16px; border: 1px dashed var(--ug-line); border-radius: 6px; color: var(--ug-dim); font-size: 12.5px; text-align: center; line-height: 1.45; }
.ug-why { margin: 4px 12px 8px; padding: 7px 10px; border-left: 3px solid #e25555; background: #2c2024; border-radius: 3px; font-size: 12.5px; color: #ffb3ad; }
.ug-state { color: var(--c); border: 1px solid color-mix(in srgb, var(--c) 45%, transparent); background: color-mix(in srgb, var(--c) 13%, transparent); border-radius: 9px; padding: 1px 8px; font-size: 11px; white-space: nowrap; flex: none; }

/* head and stepper */
.ug-head { display: flex; gap: 8px; align-items: center; padding: 2px 12px 0; }
.ug-names { flex: 1; min-width: 0; }
.ug-title { font-size: 15px; font-weight: 600; color: #eef1f5; line-height: 1.3; }
.ug-subtitle { font-size: 11.5px; color: var(--ug-dim); }
.ug-back { font-size: 24px; line-height: 1; color: var(--ug-dim); padding: 0 6px 3px 0; }
.ug-tools { display: flex; gap: 14px; padding: 5px 12px 0; font-size: 12px; }
.ug-tool { color: #9fb4d0; } .ug-tool.ug-off { color: #566070; }
.ug-stepper { display: grid; grid-template-columns: repeat(var(--n), minmax(0, 1fr)); row-gap: 6px; padding: 10px 4px 4px; }
.ug-step { position: relative; display: flex; flex-direction: column; align-items: center; gap: 4px; min-width: 0; padding: 2px 0 3px; border-radius: 6px; }
.ug-step i { z-index: 1; width: 25px; height: 25px; border-radius: 50%; display: grid; place-items: center; font: 600 12.5px/1 system-ui, sans-serif; color: var(--c); background: #1b2027; border: 1.5px solid var(--c); box-sizing: border-box; }
.ug-step span { font-size: 10px; letter-spacing: -.25px; line-height: 1.2; text-align: center; color: var(--ug-dim); max-width: 100%; overflow: hidden; text-overflow: ellipsis; overflow-wrap: break-word; hyphens: auto; display: -webkit-box; -webkit-line-clamp: 2; -webkit-box-orient: vertical; }
.ug-step::before { content: ""; position: absolute; top: 14px; left: -50%; width: 100%; height: 1.5px; background: var(--ug-line); }
.ug-step.ug-first::before { display: none; }
.ug-step.ug-is-accepted i, .ug-step.ug-is-failed i, .ug-step.ug-is-rejected i, .ug-step.ug-is-awaiting_review i { background: var(--c); color: #10151b; }
.ug-step.ug-is-running i { background: #16304f; box-shadow: 0 0 0 3px #4c9bff40; }
.ug-step.ug-is-unavailable i, .ug-step.ug-is-pending i { border-color: #414a58; color: #8a94a3; }
.ug-step.ug-selected { background: #262e39; box-shadow: inset 0 -2px var(--ug-accent); }
.ug-step.ug-selected span { color: #fff; }
label.ug-step:hover { background: #232932; }

/* status */
.ug-status { margin: 5px 12px 8px; padding: 8px 11px 9px; background: var(--ug-raised); border-left: 3px solid var(--c); border-radius: 4px; }
.ug-status-head { display: flex; justify-content: space-between; align-items: center; gap: 8px; margin-bottom: 3px; }
.ug-status-title { font-weight: 600; font-size: 13.5px; color: #eef1f5; }
.ug-status .ug-sentence { font-size: 13px; line-height: 1.35; color: var(--ug-text); overflow-wrap: anywhere; }
.ug-progress { height: 6px; border-radius: 3px; background: #10141a; margin: 8px 0 3px; overflow: hidden; }
.ug-progress > div { height: 100%; background: var(--ug-accent); border-radius: 3px; }
.ug-ends { display: flex; justify-content: space-between; font-size: 11px; color: var(--ug-dim); font-variant-numeric: tabular-nums; }

/* what was handed over */
.ug-handed { margin: 0 12px 6px; padding: 5px 10px; font-size: 12px; line-height: 1.35; background: #1b2027; border-left: 3px solid #414a58; border-radius: 3px; display: flex; flex-wrap: wrap; gap: 0 8px; align-items: baseline; }
.ug-handed.ug-on { border-left-color: #6fa3b8; }
.ug-handed .ug-name { color: var(--ug-dim); } .ug-handed .ug-value { color: var(--ug-text); flex: 1; min-width: 120px; }
.ug-handed > .ug-link { margin-left: 0; } .ug-handed .ug-links { white-space: nowrap; }

/* findings, facts, tables */
.ug-findings { margin: 2px 12px 6px; display: flex; flex-direction: column; gap: 3px; }
.ug-finding { display: flex; gap: 8px; align-items: baseline; font-size: 12.5px; line-height: 1.35; color: var(--ug-text); }
.ug-finding i { flex: none; width: 15px; height: 15px; border-radius: 50%; display: inline-grid; place-items: center; font: 700 10px/1 system-ui, sans-serif; background: color-mix(in srgb, var(--c) 22%, transparent); color: var(--c); align-self: center; }
.ug-finding .ug-sentence { flex: 1; } .ug-finding .ug-note { white-space: nowrap; }
.ug-finding.ug-is-warning .ug-sentence { color: #f0c274; } .ug-finding.ug-is-failure .ug-sentence { color: #ff9d96; }
.ug-facts { margin: 0 12px 6px; }
.ug-fact { display: flex; justify-content: space-between; gap: 12px; font-size: 12.5px; padding: 2.5px 0; border-bottom: 1px solid #262c35; }
.ug-fact:last-child { border-bottom: 0; }
.ug-fact .ug-name { color: var(--ug-dim); } .ug-fact .ug-value { color: var(--ug-text); font-variant-numeric: tabular-nums; text-align: right; overflow-wrap: anywhere; }
.ug-table { margin: 0 12px 6px; overflow-x: auto; }
.ug-table table { width: 100%; border-collapse: collapse; font-size: 12px; font-variant-numeric: tabular-nums; }
.ug-table th { text-align: right; font-weight: 500; color: var(--ug-dim); padding: 2px 0 4px 8px; vertical-align: bottom; line-height: 1.2; }
.ug-table td { text-align: right; padding: 3px 0 3px 8px; border-top: 1px solid #262c35; color: var(--ug-text); }
.ug-table th:first-child, .ug-table td:first-child { padding-left: 0; text-align: left; }
.ug-unit { display: block; font-size: 10.5px; color: #6f7a89; }

/* histogram: the slider lies under the plot, thumb by thumb below its border */
div:has(> i.ug-borders) + div { padding: 0 !important; }
div:has(> i.ug-borders) + div div:has(> p > label[for]) { display: none; }
div:has(> i.ug-borders) + div .multi-slider { margin: -10px 0 2px 62.8px; width: calc(100% - 83.6px); }
.multi-slider-thumb { width: 11px !important; height: 18px !important; border-radius: 3px !important; }
.ug-zones { display: flex; gap: 5px; margin: 4px 12px 8px; flex-wrap: wrap; }
.ug-zone { flex: 1 1 60px; border-top: 2px solid; background: var(--ug-raised); border-radius: 2px; padding: 3px 7px 4px; font-size: 11.5px; line-height: 1.35; font-variant-numeric: tabular-nums; }
.ug-zone-range { color: var(--ug-text); white-space: nowrap; } .ug-zone-share { color: var(--ug-dim); }

.ug-curves { display: flex; flex-wrap: wrap; gap: 2px 14px; margin: 0 12px 8px; font-size: 11.5px; color: var(--ug-dim); } .ug-curves i { display: inline-block; width: 12px; height: 3px; border-radius: 2px; margin-right: 6px; vertical-align: middle; }

/* pictures */
.ug-figures { display: flex; flex-direction: column; gap: 8px; padding: 2px 10px 4px; }
.ug-caption { display: flex; justify-content: space-between; align-items: baseline; font-size: 12.5px; padding: 2px 0 4px; }
.ug-caption .ug-name { color: var(--ug-text); font-weight: 500; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.ug-pixel { padding: 4px 12px 2px; }
.ug-picture { display: block; width: 100%; height: auto; border-radius: 4px; background: #0f1216; }
.ug-zoom { cursor: zoom-in; display: block; }
.ug-colourbar { margin: 4px 10px 8px; } .ug-bar { height: 9px; border-radius: 3px; margin-bottom: 3px; }
.ug-legend { margin: 4px 10px 10px; display: flex; flex-direction: column; gap: 3px; }
.ug-entry { display: flex; align-items: center; gap: 8px; font-size: 12px; }
.ug-entry i { width: 11px; height: 11px; border-radius: 3px; flex: none; }
.ug-entry .ug-name { flex: 1; color: var(--ug-text); } .ug-entry .ug-value { color: var(--ug-dim); font-variant-numeric: tabular-nums; }
.ug-mode { padding: 0 10px 2px; font-size: 11.5px; color: var(--ug-dim); }
.ug-cloud-note { display: flex; flex-direction: column; gap: 4px; font-size: 11.5px; color: var(--ug-dim); padding: 0 10px 6px; }
.ug-views .ug-link { margin: 0 0 0 12px; }

/* log, list of scans */
.ug-log { padding: 4px 10px; display: flex; flex-direction: column; gap: 7px; }
.ug-log-line { border-left: 2px solid var(--c); padding: 1px 0 1px 9px; }
.ug-log-head { font-size: 11px; color: var(--ug-dim); } .ug-log-text { font-size: 12.5px; line-height: 1.35; color: var(--ug-text); overflow-wrap: anywhere; }
.ug-log-reason { font-size: 12px; color: #f0c274; }
.ug-scans { padding: 0 10px; display: flex; flex-direction: column; gap: 6px; }
.ug-scan { display: block; background: var(--ug-raised); border: 1px solid transparent; border-radius: 6px; padding: 8px 11px; }
label.ug-scan:hover { border-color: #44618a; background: #242b35; }
.ug-scan-head { display: flex; justify-content: space-between; gap: 8px; align-items: center; }
.ug-scan-head .ug-name { font-size: 13.5px; font-weight: 600; color: #eef1f5; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.ug-scan-facts { display: flex; justify-content: space-between; gap: 8px; font-size: 11.5px; color: var(--ug-dim); margin-top: 3px; }
.ug-dots { display: inline-flex; gap: 3px; align-items: center; } .ug-dots i { width: 6px; height: 6px; border-radius: 50%; background: #3a4350; } .ug-dots i.ug-on { background: var(--c); }
.ug-pager { display: flex; justify-content: center; gap: 24px; padding: 8px; }
.ug-upload, .ug-set-up { margin: 0; }

/* a rig without a scan */
.ug-devices { padding: 0 10px; display: flex; flex-direction: column; gap: 6px; margin-bottom: 6px; }
.ug-device { background: var(--ug-raised); border-radius: 6px; padding: 6px 10px 7px; }
.ug-device .ug-name { font-size: 13px; font-weight: 600; color: #eef1f5; }
.ug-device .ug-note { line-height: 1.4; overflow-wrap: anywhere; }
.ug-rig-link { display: flex; gap: 8px; align-items: center; padding: 2px 2px 0; }
.ug-owner { margin-top: 8px; border-left-color: var(--ug-amber); color: #f0c274; }
.ug-patterns { display: flex; flex-wrap: wrap; gap: 5px; padding: 2px 12px 8px; }
.ug-pattern { border: 1px solid var(--ug-line); border-radius: 11px; padding: 2px 10px 3px; font-size: 12px; color: #b4bcc8; background: #12151a; }
label.ug-pattern:hover { border-color: #44618a; color: #fff; } .ug-pattern.ug-on { background: #1d4674; border-color: var(--ug-accent); color: #fff; } .ug-pattern.ug-off { opacity: .55; }
div:has(> i.ug-bare) + div div:has(> p > label[for]) { width: 42% !important; visibility: hidden; }
div:has(> i.ug-bare) + div .mantine-NumberInput-root, div:has(> i.ug-bare) + div .mantine-Slider-markWrapper { display: none; }
div:has(> i.ug-bare) + div { padding-block: 2px 14px !important; }
.ug-live-card { margin: 2px 12px 8px; }
.ug-live-head { display: flex; justify-content: space-between; align-items: baseline; font-size: 12.5px; }
.ug-live-head .ug-name { color: var(--ug-text); font-weight: 600; } .ug-live-head i { display: inline-block; width: 10px; height: 10px; border-radius: 2px; margin-right: 7px; }
.ug-shares { display: flex; justify-content: space-between; font-size: 12px; color: var(--ug-dim); margin: 2px 0 1px; font-variant-numeric: tabular-nums; } .ug-shares b { font-weight: 500; color: var(--ug-text); } .ug-shares i { display: inline-block; width: 7px; height: 7px; border-radius: 1px; margin-right: 5px; vertical-align: 1px; }
.ug-late { color: var(--ug-amber); }
.ug-rig-title { display: -webkit-box; -webkit-line-clamp: 2; -webkit-box-orient: vertical; overflow: hidden; white-space: normal; overflow-wrap: anywhere; }
.ug-sharp { display: flex; align-items: center; gap: 8px; font-size: 12px; color: var(--ug-dim); } .ug-sharp .ug-progress { flex: 1; margin: 0; } .ug-sharp .ug-value { min-width: 88px; text-align: right; color: var(--ug-text); font-variant-numeric: tabular-nums; }
.ug-live-foot { display: flex; justify-content: space-between; align-items: baseline; padding: 0 12px 6px; }
.ug-work { margin: 2px 12px 8px; } .ug-work .ug-ends { gap: 12px; } .ug-work .ug-ends span:last-child { white-space: nowrap; }
"""

STYLE = f"<style>{_CSS}</style>"
