//! Real files, where they are there: a street scene through the full-size TransFuser, and a published checkpoint.

use model_compiler::import::System;
use serde_json::Value;
use tests::commands::{self, Folder};
use tests::golden;

/// The only folder of frames that the street scene is in, without the files beside it.
fn street(folder: &Folder) -> bool {
    let Some(kitti) = commands::shared("data/kitti/000008") else { return false };
    for file in ["rgb.png", "lidar.bin", "frame.json"] {
        folder.write(&format!("kitti/000008/{file}"), std::fs::read(kitti.join(file)).unwrap());
    }
    true
}

fn waypoints(document: &Value) -> Vec<f64> {
    let pairs = document["frames"][0]["waypoints"].as_array().expect("waypoints");
    pairs.iter().flat_map(|pair| pair.as_array().expect("a pair")).filter_map(Value::as_f64).collect()
}

/// From camera image and point cloud to waypoints, in f32 and in integers; every byte of every step is proven.
#[test]
fn a_street_scene_goes_through_transfuser() {
    let folder = Folder::default();
    if !street(&folder) {
        return;
    }
    golden::write_safetensors(&golden::checkpoint(System::TransFuser), &folder.path("net.safetensors")).unwrap();
    folder.write("inputs.safetensors", std::fs::read(golden::path("inputs.safetensors")).unwrap());
    folder.ok("model-compiler compile @net.safetensors --calib @inputs.safetensors -o @net.img");
    let (status, float) = folder.json("host-sim run @net.safetensors --frames @kitti --json");
    assert_eq!((status, &float["frames"][0]["name"]), (0, &"000008".into()));
    let (status, int8) = folder.json("host-sim run @net.img --frames @kitti --json");
    assert_eq!(status, 0);
    let (status, report) = folder.json("host-sim verify @net.img --model @net.safetensors --frames @kitti --json");
    assert_eq!((status, &report["bytes_equal"]), (0, &true.into()), "{}", report["first_difference"]);
    let (float, int8) = (waypoints(&float), waypoints(&int8));
    println!("000008 f32  right, forward, m: {float:.3?}");
    println!("000008 int8 right, forward, m: {int8:.3?}");
    println!("worst step {} at {} dB", report["summary"]["worst_step"], report["summary"]["worst_sqnr_db"]);
    assert_eq!(waypoints(&report), int8, "run and verify agree");
    assert_eq!((float.len(), int8.len()), (8, 8));
    let largest = float.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let distances = float.chunks(2).zip(int8.chunks(2)).map(|(f, i)| (f[0] - i[0]).hypot(f[1] - i[1]));
    let worst = distances.fold(0.0_f64, f64::max);
    assert!(worst < 0.1 * largest, "{worst} m apart, of {largest} m");
}

#[test]
fn a_published_checkpoint_is_listed() {
    let Some(path) = commands::shared("data/models/resnet20-12fca82f.th") else { return };
    let folder = Folder::default();
    folder.write("resnet20.th", std::fs::read(path).unwrap());
    let text = folder.ok("model-compiler inspect @resnet20.th");
    for part in
        ["system      not recognized", "conv1.weight", "layer3.2.bn2.running_var", "linear.bias", "[16, 3, 3, 3]"]
    {
        assert!(text.contains(part), "no {part:?} in:\n{text}");
    }
    // 19 convolutions and as many batch norms of five tensors less the counters of old torch, and the linear layer.
    let tensors = text.lines().filter(|line| line.contains(" F32 ")).count();
    assert!(text.contains(&format!("tensors     {tensors}, ")), "{tensors} lines in:\n{text}");
    println!("{}", text.lines().take(5).collect::<Vec<_>>().join("\n"));
    let outcome = folder.run("model-compiler compile @resnet20.th --calib @resnet20.th -o @resnet20.img");
    assert_eq!(outcome.status, 2);
    assert!(
        outcome.err.starts_with("error: @resnet20.th: the tensor names are of no known system ("),
        "{}",
        outcome.err
    );
}

/// A published ResNet-20, calibrated on 500 training images: classes and logits of 500 test images against f32.
#[test]
fn a_published_classifier_keeps_its_logits() {
    let (Some(model), Some(calibration), Some(test)) = (
        commands::shared("data/models/resnet20-12fca82f.onnx"),
        commands::shared("data/cifar10/calibration"),
        commands::shared("data/cifar10/test"),
    ) else {
        return;
    };
    let folder = Folder::default();
    let (model, calibration, test) = (model.display(), calibration.display(), test.display());
    folder.ok(&format!("model-compiler compile {model} --calib {calibration} --target cortex-m4 -o @resnet20.img"));
    let (status, report) =
        folder.json(&format!("host-sim verify @resnet20.img --model {model} --frames {test} --json"));
    assert_eq!((status, &report["bytes_equal"]), (0, &true.into()), "{}", report["first_difference"]);
    let found = &report["summary"]["accuracy"];
    println!("{found:#}");
    let figure = |value: &Value| value.as_f64().expect("a figure");
    assert_eq!(found["int8"]["frames"], 500);
    assert!(figure(&found["f32"]["top1"]) >= 0.909);
    assert!(figure(&found["int8"]["top1"]) >= 0.905);
    assert!(figure(&found["agreement"]["share"]) >= 0.985);
    assert!(figure(&found["logits_sqnr_db"]) >= 34.0);
    assert!(report["summary"]["arena_bytes"].as_u64() <= Some(34_000));
}
