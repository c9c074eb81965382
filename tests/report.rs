//! The report of a verification as a user gets it: page and JSON, the schema, comparison with an earlier report, gates.

use model_compiler::import::System;
use serde_json::{Value, json};
use std::path::Path;
use tests::project::{Outcome, Project};

const VERIFY: &str = "verify net.img --model net.safetensors --inputs inputs.safetensors";

fn report_files(folder: &Path) -> (String, Value) {
    let page = std::fs::read_to_string(folder.join("report.html")).unwrap();
    let document = serde_json::from_slice(&std::fs::read(folder.join("report.json")).unwrap()).unwrap();
    (page, document)
}

/// Runs a verification that writes its report to `folder`.
fn verified(project: &Project, folder: &Path, options: &str) -> Outcome {
    project.host_sim(&format!("{VERIFY} --report {}{options}", folder.display()))
}

/// Checks a value against the part of JSON Schema that the generator uses; a key that is not declared is an error.
fn check(value: &Value, schema: &Value, root: &Value, at: &str) -> Result<(), String> {
    let fail = |message: String| Err(format!("{at}: {message}"));
    if let Some(reference) = schema["$ref"].as_str() {
        let target = reference.strip_prefix('#').and_then(|pointer| root.pointer(pointer));
        return target.map_or(fail(format!("{reference} leads nowhere")), |target| check(value, target, root, at));
    }
    if let Some(any) = schema["anyOf"].as_array() {
        let mut errors = any.iter().map(|option| check(value, option, root, at)).filter_map(Result::err);
        return if errors.by_ref().count() < any.len() { Ok(()) } else { fail(format!("{value} is none of {any:?}")) };
    }
    if let Some(allowed) = schema["enum"].as_array()
        && !allowed.contains(value)
    {
        return fail(format!("{value} is none of {allowed:?}"));
    }
    let types: Vec<&str> = match &schema["type"] {
        Value::String(one) => vec![one],
        Value::Array(several) => several.iter().filter_map(Value::as_str).collect(),
        _ => return fail(format!("the schema gives no type: {schema}")),
    };
    let found = match value {
        Value::Null => "null",
        Value::Bool(_) => "boolean",
        Value::Number(n) if n.is_u64() || n.is_i64() => "integer",
        Value::Number(_) => "number",
        Value::String(_) => "string",
        Value::Array(_) => "array",
        Value::Object(_) => "object",
    };
    if !(types.contains(&found) || found == "integer" && types.contains(&"number")) {
        return fail(format!("found {found}, expected {types:?}"));
    }
    if let Value::Array(items) = value {
        let length = items.len() as u64;
        if schema["minItems"].as_u64().is_some_and(|min| length < min)
            || schema["maxItems"].as_u64().is_some_and(|max| length > max)
        {
            return fail(format!("{length} items"));
        }
        for (index, item) in items.iter().enumerate() {
            check(item, &schema["items"], root, &format!("{at}[{index}]"))?;
        }
    }
    if let Value::Object(fields) = value {
        for required in schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str) {
            if !fields.contains_key(required) {
                return fail(format!("field {required} is missing"));
            }
        }
        for (name, field) in fields {
            let declared = &schema["properties"][name];
            if declared.is_null() {
                return fail(format!("field {name} is not in the schema"));
            }
            check(field, declared, root, &format!("{at}.{name}"))?;
        }
    }
    Ok(())
}

/// Every property of every object has a description.
fn assert_described(schema: &Value, at: &str) {
    match schema {
        Value::Object(fields) => {
            for (name, property) in fields.get("properties").and_then(Value::as_object).into_iter().flatten() {
                assert!(property["description"].is_string(), "{at}: {name} has no description");
            }
            fields.iter().for_each(|(name, inner)| assert_described(inner, &format!("{at}/{name}")));
        }
        Value::Array(items) => items.iter().for_each(|item| assert_described(item, at)),
        _ => {}
    }
}

#[test]
fn the_report_is_a_page_and_a_document_that_follows_its_schema() {
    let project = Project::new(System::TransFuser);
    let folder = project.path("new/out");
    let outcome = verified(&project, &folder, " --mirror --min-sqnr 0");
    assert_eq!(outcome.status, 0, "{}", outcome.err);
    let (page, document) = report_files(&folder);
    for section in ["sqnr", "noise", "tensors", "channels", "memory", "waypoints", "frames", "gates", "steps"] {
        assert!(page.contains(&format!("<section id=\"{section}\">")), "{section}");
    }
    assert!(page.contains("4 of 8 frames are also calibration frames"));
    assert!(!page.contains("http") && page.len() < 3_000_000, "{} B", page.len());
    let schema: Value = serde_json::from_str(&project.host_sim("schema").out).unwrap();
    assert_described(&schema, "");
    check(&document, &schema, &schema, "report").unwrap();
    // The check can fail.
    let mut damaged = document.clone();
    damaged["steps"][3]["headroom_bits"] = "three".into();
    assert!(check(&damaged, &schema, &schema, "report").unwrap_err().starts_with("report.steps[3].headroom_bits"));
    damaged = document.clone();
    damaged["summary"].as_object_mut().unwrap().remove("flash_bytes");
    assert!(check(&damaged, &schema, &schema, "report").unwrap_err().contains("flash_bytes is missing"));
    damaged = document;
    damaged["summary"]["arena_status"] = "best".into();
    assert!(check(&damaged, &schema, &schema, "report").is_err());
    let (status, failed) = project.json(&format!("{VERIFY} --min-sqnr 200 --json"));
    assert_eq!(status, 1);
    check(&failed, &schema, &schema, "report").unwrap();
}

#[test]
fn figures_of_the_report_hang_together() {
    let project = Project::new(System::TransFuser);
    let folder = project.path("out");
    assert_eq!(verified(&project, &folder, "").status, 0);
    let (_, document) = report_files(&folder);
    let sum = |counts: &Value| counts.as_array().unwrap().iter().map(|n| n.as_u64().unwrap()).sum::<u64>();
    let frames = document["frames"].as_array().unwrap().len() as u64;
    let arena = document["summary"]["arena_bytes"].as_u64().unwrap();
    for step in document["steps"].as_array().unwrap() {
        let elements: u64 = step["shape"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap()).product();
        let histogram = &step["histogram"];
        assert_eq!(
            (sum(&histogram["f32"]), sum(&histogram["codes"])),
            (frames * elements, frames * elements),
            "{step}"
        );
        let weighted = ["conv2d", "linear"].contains(&step["op"].as_str().unwrap());
        assert_eq!(step["channels"].is_object(), weighted, "{}", step["step"]);
        if weighted {
            assert_eq!(step["channels"]["min"].as_array().unwrap().len() as u64, step["shape"][2].as_u64().unwrap());
        }
    }
    let end = |buffer: &Value| buffer["offset"].as_u64().unwrap() + buffer["bytes"].as_u64().unwrap();
    let ends = document["memory"]["buffers"].as_array().unwrap().iter().map(end);
    assert!(ends.max().unwrap() <= arena);
    let shares = document["noise"]["shares"].as_array().unwrap();
    let total: f64 = shares.iter().map(|share| share["share"].as_f64().unwrap()).sum();
    assert!((total - 1.0).abs() < 1e-9, "{total}");
    // The measured vector's own step is the last that can contribute.
    let measured = document["noise"]["measured"].as_str().unwrap();
    let last = shares.iter().map(|s| s["position"].as_u64().unwrap()).max().unwrap();
    assert_eq!(document["steps"][last as usize]["step"], measured);
}

#[test]
fn a_later_report_is_compared_with_an_earlier_one() {
    let project = Project::new(System::Aim);
    let (old, new) = (project.path("old"), project.path("new"));
    assert_eq!(verified(&project, &old, "").status, 0);
    let (_, mut document) = report_files(&old);
    // The earlier report was better by 1.5 dB at one step, had another name for a second, and a smaller arena.
    let better = document["steps"][4]["sqnr_db"].as_f64().unwrap() + 1.5;
    document["steps"][4]["sqnr_db"] = better.into();
    document["steps"][5]["step"] = "gone".into();
    document["summary"]["arena_bytes"] = 16.into();
    let path = project.path("edited.json");
    std::fs::write(&path, document.to_string()).unwrap();
    let step = document["steps"][4]["step"].as_str().unwrap();
    let baseline = format!(" --baseline {}", path.display());
    let outcome = verified(&project, &new, &baseline);
    assert_eq!(outcome.status, 0, "{}", outcome.err);
    assert!(outcome.out.lines().any(|line| line.trim().starts_with("−1.5") && line.ends_with(step)), "{}", outcome.out);
    assert!(outcome.out.contains("only in the earlier report: gone"), "{}", outcome.out);
    let (page, compared) = report_files(&new);
    assert!(page.contains("<section id=\"changes\">") && page.contains("Only in the earlier report"));
    assert_eq!(compared["baseline"]["steps"][0]["step"], step);
    // The same without running anything.
    let command = format!("diff {} {}", path.display(), new.join("report.json").display());
    let outcome = project.host_sim(&format!("{command} --report {}", project.path("changes").display()));
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""));
    assert!(outcome.out.contains("1 of ") && outcome.out.contains("−1.5"), "{}", outcome.out);
    assert!(std::fs::read_to_string(project.path("changes/diff.html")).unwrap().replace("<wbr>", "").contains(step));
    let (status, changes) = project.json(&format!("{command} --max-loss 1 --json"));
    assert_eq!((status, &changes["gates"][0]["met"], &changes["steps"][0]["step"]), (1, &json!(false), &json!(step)));
    assert_eq!(changes["error"]["where"], format!("gate max_loss_db: step {step}"));
    // A gate on the loss, met and missed.
    assert_eq!(verified(&project, &new, &format!("{baseline} --max-loss 1.6")).status, 0);
    let missed = verified(&project, &new, &format!("{baseline} --max-loss 1.4"));
    assert_eq!(missed.status, 1);
    let expected = format!("gate max_loss_db: step {step}: found 1.50 dB, expected at most 1.4 dB");
    assert!(missed.err.contains(&expected), "{}", missed.err);
}

#[test]
fn a_report_compared_with_itself_shows_no_change() {
    let project = Project::new(System::Aim);
    let folder = project.path("out");
    assert_eq!(verified(&project, &folder, "").status, 0);
    let file = folder.join("report.json").display().to_string();
    let (status, diff) = project.json(&format!("diff {file} {file} --max-loss 0 --json"));
    assert_eq!(status, 0, "{diff}");
    assert!(diff["steps"].as_array().unwrap().iter().all(|step| step["change_db"] == 0.0), "{diff}");
    assert!(project.host_sim(&format!("diff {file} {file}")).out.contains("0 of "));
}

#[test]
fn a_gate_file_is_kept_or_missed() {
    let project = Project::new(System::Aim);
    let gate = |text: &str| {
        std::fs::write(project.path("gates.toml"), text).unwrap();
        project.host_sim(&format!("{VERIFY} --gate gates.toml"))
    };
    let kept = gate("min_sqnr_db = 1\nmax_waypoint_error_mm = 1e9\nmax_arena_bytes = 100000000\n[steps]\n\"*\" = 1\n");
    assert_eq!(kept.status, 0, "{}", kept.err);
    assert!(kept.out.contains("gate max_arena_bytes met"), "{}", kept.out);
    let missed = gate("min_output_sqnr_db = 150\nmax_flash_bytes = 10\n");
    assert_eq!(missed.status, 1);
    assert!(missed.err.contains("error: gate min_output_sqnr_db: step waypoints: found "), "{}", missed.err);
    assert!(missed.err.contains("1 more gate is missed"), "{}", missed.err);
    for (text, expected) in [
        ("max_arena = 3", "unknown field `max_arena`"),
        ("\n\nmin_sqnr_db = nan", "line 3: min_sqnr_db"),
        ("[steps]\n\"nowhere.*\" = 3", "no step of this model matches"),
        ("max_loss_db = 1", "needs an earlier report"),
    ] {
        let refused = gate(text);
        assert_eq!((refused.status, refused.out.as_str()), (2, ""), "{text}");
        assert!(refused.err.contains(expected), "{expected} not in: {}", refused.err);
    }
}

#[test]
fn files_that_are_no_reports_are_refused_and_nothing_is_left_half_written() {
    let project = Project::new(System::Aim);
    std::fs::write(project.path("other.json"), b"{\"schema\": 1}").unwrap();
    let folder = project.path("out");
    for (options, expected) in [
        (" --baseline other.json", "this is no report of a verification: missing field"),
        (" --baseline absent.json", "absent.json"),
        (" --gate absent.toml", "absent.toml"),
    ] {
        let outcome = verified(&project, &folder, options);
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{options}");
        assert!(outcome.err.contains(expected), "{expected} not in: {}", outcome.err);
        assert!(!folder.exists(), "{options}");
    }
    let outcome = project.host_sim("diff other.json other.json");
    assert!(outcome.status == 2 && outcome.err.contains("report.json"), "{}", outcome.err);
    // The folder is a file.
    let outcome = verified(&project, &project.path("net.img"), "");
    assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{}", outcome.err);
}
