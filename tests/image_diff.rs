//! What `inspect --diff` says of two images.

use firmware::image::{Image, SectionKind};
use model_compiler::emit::{AlignedBytes, reseal};
use model_compiler::import::System;
use model_compiler::quantize::QuantizeOptions;
use serde_json::Value;
use tests::build;
use tests::commands::Folder;
use tests::golden::{Lbc, Network};

/// A folder with `a.img` of a small network.
fn folder(system: System) -> Folder {
    let folder = Folder::of(&Network::small(system));
    folder.ok("model-compiler quantize @net.safetensors --calib @inputs.safetensors -o @net.qmodel");
    folder.ok("model-compiler compile @net.qmodel -o @a.img");
    folder
}

fn list<'a>(document: &'a Value, name: &str) -> &'a Vec<Value> {
    document[name].as_array().unwrap_or_else(|| panic!("{name} of {document}"))
}

#[test]
fn equal_images_give_status_0() {
    let folder = folder(System::Aim);
    folder.ok("model-compiler compile @net.qmodel -o @b.img");
    assert_eq!(folder.ok("model-compiler inspect --diff @a.img @b.img"), "the images are equal\n");
    let (status, document) = folder.json("model-compiler inspect --diff @a.img @b.img --json");
    let nothing = serde_json::json!({"equal": true, "header": [], "ports": [], "sections": [], "steps": []});
    assert_eq!((status, document), (0, nothing));
}

#[test]
fn a_changed_weight_names_its_step_and_counts_its_bytes() {
    let folder = folder(System::Aim);
    let mut image = folder.read("a.img");
    let (position, weights, at) = {
        let bytes = AlignedBytes::from(image.as_slice());
        let parsed = Image::parse(&bytes).unwrap();
        let linear = |position: &u16| matches!(parsed.step(*position), Some(firmware::program::Step::Linear(_)));
        let position = (0..parsed.step_count()).find(linear).unwrap();
        let Some(firmware::program::Step::Linear(step)) = parsed.step(position) else { unreachable!() };
        let section = parsed.section(SectionKind::Constants).as_ptr().addr() - bytes.as_ptr().addr();
        (position, step.weights.bytes, section + step.weights.offset as usize)
    };
    image[at] ^= 1;
    image[at + 5] ^= 1;
    reseal(&mut image);
    folder.write("b.img", image);
    let (status, document) = folder.json("model-compiler inspect --diff @a.img @b.img --json");
    let steps = serde_json::json!([{
        "op": "linear", "before": position, "after": position, "fields": [], "answer": false, "constants": [
            {"what": "weights", "before_bytes": weights, "after_bytes": weights, "different_bytes": 2}
        ]
    }]);
    assert_eq!((status, &document["equal"], &document["steps"]), (1, &false.into(), &steps));
    let sections: Vec<&str> = list(&document, "sections").iter().filter_map(|s| s["section"].as_str()).collect();
    assert_eq!(sections, ["constants"]);
    let header: Vec<&str> = list(&document, "header").iter().filter_map(|s| s["what"].as_str()).collect();
    assert_eq!(header, ["sha256"]);
    let text = folder.run("model-compiler inspect --diff @a.img @b.img");
    assert_eq!((text.status, text.err.as_str()), (1, ""));
    assert!(text.out.ends_with("1 steps changed, 0 added, 0 removed; 2 bytes of constants differ\n"), "{}", text.out);
    assert!(text.out.contains(&format!("{weights} B, 2 differ")), "{}", text.out);
}

/// Two targets: another packing, another arena, another order; nothing that a step computes.
#[test]
fn another_target_changes_kernels_and_places_but_no_answer() {
    for system in System::ALL {
        let graph = match system {
            System::Lbc => build::lbc(&Lbc::small(), false),
            system => build::small(&Network::small(system)),
        };
        let model = build::quantized(&graph, &QuantizeOptions::default());
        let folder = Folder::default();
        for (name, target) in [("a.img", "portable"), ("b.img", "x86")] {
            folder.write(name, build::compiled_for(&model, target).image);
        }
        let (status, document) = folder.json("model-compiler inspect --diff @a.img @b.img --json");
        assert_eq!(status, 1, "{document}");
        let steps = list(&document, "steps");
        let same = |step: &Value| step["answer"] == false && !step["before"].is_null() && !step["after"].is_null();
        assert!(steps.iter().all(same), "{system:?}: {document}");
        let changed = |what: &str| {
            let fields = |step: &Value| list(step, "fields").iter().any(|field| field["what"] == what);
            steps.iter().filter(|step| fields(step)).count()
        };
        assert!(changed("kernel") > 0, "{system:?}: {document}");
        assert!(list(&document, "ports").is_empty(), "{document}");
    }
}

#[test]
fn another_network_has_other_steps_ports_and_digests() {
    let (aim, fusion) = (folder(System::Aim), folder(System::LateFusion));
    aim.write("b.img", fusion.read("a.img"));
    let (status, document) = aim.json("model-compiler inspect --diff @a.img @b.img --json");
    assert_eq!(status, 1);
    let count = |name: &str| {
        let bytes = AlignedBytes::from(aim.read(name).as_slice());
        usize::from(Image::parse(&bytes).unwrap().step_count())
    };
    let steps = list(&document, "steps");
    let only = |side: &str| steps.iter().filter(|step| step[side].is_null()).count();
    let (added, removed) = (only("before"), only("after"));
    assert!(added > 0 && count("a.img") + added == count("b.img") + removed, "{added} added, {removed} removed");
    let ports = list(&document, "ports");
    let velocity = ports.iter().find(|port| port["what"] == "input velocity");
    assert!(velocity.is_some_and(|port| port["before"].is_null() != port["after"].is_null()) || !ports.is_empty());
    let header: Vec<&str> = list(&document, "header").iter().filter_map(|s| s["what"].as_str()).collect();
    assert!(["bytes", "sha256", "qmodel", "steps"].iter().all(|what| header.contains(what)), "{header:?}");
}

#[test]
fn what_cannot_be_compared_is_said() {
    let folder = folder(System::Aim);
    let outcome = folder.run("model-compiler inspect --diff @net.qmodel @a.img");
    let expected = "error: @net.qmodel: header byte 0: this is not a model image: found 81, expected 147\n  help: the \
                    image is damaged or incomplete: copy it again, or compile the model again\n";
    assert_eq!((outcome.status, outcome.out.as_str(), outcome.err.as_str()), (2, "", expected));
    let outcome = folder.run("model-compiler inspect --diff @none.img @a.img");
    assert_eq!(
        (outcome.status, outcome.err.as_str()),
        (2, "error: @none.img: No such file or directory (os error 2)\n  help: check the path\n")
    );
    assert_eq!(folder.run("model-compiler inspect @a.img --json").status, 2);
}
