//! LBC through the two programs, from a checkpoint of torch and frames to points in the image.

use image::{ExtendedColorType, save_buffer};
use model_compiler::frames::Frame;
use serde_json::Value;
use tests::build;
use tests::commands::{self, Folder, torch, views_file};
use tests::golden::Lbc;

/// The options that a small network needs.
const OPTIONS: &str = "--resolution 48x64";

/// A folder with `net.ckpt`, as PyTorch Lightning saves it, and `inputs.safetensors`.
fn folder() -> Folder {
    let folder = Folder::default();
    folder.write("net.ckpt", commands::lightning(torch(&Lbc::small().tensors())));
    folder.write("inputs.safetensors", views_file(&build::views((48, 64))));
    folder
}

fn points(frame: &Value) -> Vec<f64> {
    let points = frame["points"].as_array().expect("points");
    points.iter().flat_map(|point| point.as_array().expect("a pair")).filter_map(Value::as_f64).collect()
}

fn apart(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    found.iter().zip(expected).map(|(f, e)| (f - e).abs()).fold(0.0, f64::max)
}

#[test]
fn image_and_checkpoint_point_to_the_same_places() {
    let folder = folder();
    for hack in ["", " --hack"] {
        folder.ok(&format!("model-compiler compile @net.ckpt {OPTIONS}{hack} --calib @inputs.safetensors -o @net.img"));
        let (status, float) =
            folder.json(&format!("host-sim run @net.ckpt {OPTIONS}{hack} --inputs @inputs.safetensors --json"));
        assert_eq!(status, 0, "{float}");
        let (status, int8) = folder.json("host-sim run @net.img --inputs @inputs.safetensors --json");
        assert_eq!(status, 0, "{int8}");
        let verify = "host-sim verify @net.img --model @net.ckpt --inputs @inputs.safetensors --mirror --json";
        let (status, report) = folder.json(&format!("{verify} {OPTIONS}{hack}"));
        assert_eq!((status, &report["bytes_equal"]), (0, &true.into()), "{}", report["first_difference"]);
        for i in 0..4 {
            let [float, int8] = [&float, &int8].map(|document| points(&document["frames"][i]));
            assert_eq!(float.len(), 6);
            assert!(float.iter().all(|v| (-1.0..=1.0).contains(v)), "{float:?}");
            assert!(apart(&int8, &float) < 0.1, "{int8:?} for {float:?}");
            // A report holds what single precision holds of sixty-fourths of a pixel, which is all of it.
            assert!(apart(&points(&report["frames"][i]), &int8) < 1e-6, "run and verify agree");
        }
        let errors = report["summary"]["point_error_px"].as_array().expect("errors of points");
        assert_eq!((errors.len(), report["frames"].as_array().map(Vec::len)), (3, Some(8)));
        assert!(report["summary"]["vector_sqnr_db"].is_null(), "nothing that the points come from is pooled");
        assert_eq!(report["summary"]["waypoint_error_mm"], Value::Array(vec![]));
        assert_eq!(report["summary"]["output_step"], "points");
    }
}

#[test]
fn temperature_draws_the_points_together() {
    let folder = folder();
    let spread = |temperature: &str| {
        let command = "host-sim run @net.ckpt --inputs @inputs.safetensors --frames-limit 1 --json";
        let (status, run) = folder.json(&format!("{command} {OPTIONS}{temperature}"));
        assert_eq!(status, 0, "{run}");
        points(&run["frames"][0])
    };
    assert_eq!(spread(""), spread(" --temperature 5"));
    let far = spread(" --temperature 1000");
    assert!(far.iter().all(|v| v.abs() < 0.01), "even weights expect the middle: {far:?}");
    assert!(apart(&spread(" --temperature 0.5"), &far) > 0.01);
}

#[test]
fn gates_tables_ablation_and_measurement_know_points() {
    let folder = folder();
    folder.ok(&format!("model-compiler compile @net.ckpt {OPTIONS} --calib @inputs.safetensors -o @net.img"));
    folder.write("gates.toml", "max_point_error_px = 0.001\n");
    let verify = format!("host-sim verify @net.img --model @net.ckpt --inputs @inputs.safetensors {OPTIONS}");
    let outcome = folder.run(&format!("{verify} --gate @gates.toml --report @report"));
    assert_eq!(outcome.status, 1, "{}", outcome.err);
    assert!(outcome.err.contains("gate max_point_error_px: point "), "{}", outcome.err);
    assert!(outcome.out.contains("px off on average"), "{}", outcome.out);
    let page = String::from_utf8(folder.read("report/report.html")).unwrap();
    for part in ["Points of frame inputs#0 on its front view", "Point error", "point error, px"] {
        assert!(page.contains(part), "{part}");
    }
    let table = folder.ok("host-sim run @net.img --inputs @inputs.safetensors");
    assert!(table.contains("points from −1 (left, top) to 1 (right, bottom)"), "{table}");
    let (status, rows) = folder.json(&format!(
        "host-sim ablate @net.ckpt --calib @inputs.safetensors --inputs @inputs.safetensors --frames-limit 1 --json {OPTIONS}"
    ));
    assert_eq!(status, 0, "{rows}");
    let fidelity = &rows["variants"][0]["fidelity"];
    assert_eq!(fidelity["points"]["mean_px"].as_array().map(Vec::len), Some(3));
    assert!(fidelity["vector_sqnr_db"].as_f64() > Some(10.0), "of the logits: {fidelity}");
    let measured = folder.ok("host-sim bench @net.img --rounds 1 --all");
    assert!(measured.contains("spatial_softmax"), "{measured}");
}

/// Cameras larger than the network's views, and the goal, as files.
fn write_frame(folder: &Folder, name: &str, frame: &Frame) {
    let views = frame.views.as_ref().expect("views");
    let (width, height) = (usize::from(views.shape.width), usize::from(views.shape.height));
    folder.write(&format!("{name}/frame.json"), r#"{"goal": [2.0, 46.0]}"#);
    for (camera, file) in ["rgb.png", "rgb_left.png", "rgb_right.png"].into_iter().enumerate() {
        let mut pixels = vec![9; (width + 4) * (height + 2) * 3];
        for (pixel, levels) in views.data.chunks(10).enumerate() {
            let at = (pixel / width + 1) * (width + 4) + pixel % width + 2;
            (0..3).for_each(|c| pixels[3 * at + c] = levels[3 * camera + c] as u8);
        }
        let (w, h) = (width as u32 + 4, height as u32 + 2);
        save_buffer(folder.path(&format!("{name}/{file}")), &pixels, w, h, ExtendedColorType::Rgb8).unwrap();
    }
}

#[test]
fn frame_folders_are_the_cropped_cameras_and_the_heatmap_of_the_goal() {
    let folder = folder();
    let mut frames = build::views((48, 64));
    for (i, frame) in frames.iter_mut().enumerate() {
        write_frame(&folder, &format!("drive/{i}"), frame);
        let views = frame.views.as_mut().unwrap();
        let heatmap = model_compiler::frames::views::heatmap([2.0, -46.0], 48, 64);
        views.data.chunks_mut(10).zip(heatmap).for_each(|(pixel, heat)| pixel[9] = heat);
    }
    folder.write("drive.safetensors", views_file(&frames));
    let run = |frames: &str| {
        let (status, run) = folder.json(&format!("host-sim run @net.ckpt {OPTIONS} {frames} --json"));
        assert_eq!(status, 0, "{run}");
        run["frames"].as_array().expect("frames").iter().flat_map(points).collect::<Vec<_>>()
    };
    let (of_folders, of_file) = (run("--frames @drive"), run("--inputs @drive.safetensors"));
    assert!(apart(&of_folders, &of_file) < 1e-5, "{of_folders:?} and {of_file:?}");
    std::fs::remove_file(folder.path("drive/2/rgb_left.png")).unwrap();
    let outcome = folder.run(&format!("host-sim run @net.ckpt {OPTIONS} --frames @drive"));
    assert_eq!(outcome.status, 2);
    assert!(outcome.err.contains("@drive/2/rgb_left.png"), "{}", outcome.err);
}

#[test]
fn inputs_that_are_no_views_are_refused_by_name() {
    let folder = folder();
    let run = format!("host-sim run @net.ckpt {OPTIONS} --inputs @bad.safetensors");
    let mut bright = build::views((48, 64));
    bright[1].views.as_mut().unwrap().data[7] = 510.0;
    for (frames, expected) in [
        (bright, "@bad.safetensors: tensor `lbc_input`: holds 2, expected values 0..=1"),
        (build::views((40, 64)), "tensor `lbc_input`: F32 [4, 10, 40, 64], expected F32 [N, 10, 48, 64]"),
    ] {
        folder.write("bad.safetensors", views_file(&frames));
        let outcome = folder.run(&run);
        assert_eq!(outcome.status, 2);
        assert!(outcome.err.contains(expected), "{}", outcome.err);
    }
}
