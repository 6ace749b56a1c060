"""One file per stage: settings, result, function. A stage knows no rig, no storage and no HTTP."""
