//! Several memory regions, whole ways: random networks and the bundled TransFuser spread over two, three and four
//! memories give the bytes of the one-region image, whatever lies in dead bytes; and what is wrong is said by name.

use firmware::engine::{Engine, Progress};
use firmware::image::known_answer::Generator;
use firmware::image::{Image, TensorRecord};
use firmware::kernels::Portable;
use firmware::tensor::TensorId;
use host_sim::buffers::GuardedArena;
use model_compiler::emit::AlignedBytes;
use model_compiler::error::{ErrorCode, Result};
use model_compiler::import::System;
use model_compiler::memory_plan::{MemoryPlan, PlanOptions};
use model_compiler::pipeline::{self, Compiled};
use model_compiler::qmodel::QModel;
use model_compiler::quantize::{QuantizeOptions, SkipStages};
use model_compiler::target::{Region, Target};
use tests::commands::Folder;
use tests::golden::Network;
use tests::trial::live_ranges_are_true;
use tests::{build, bundle, random_graph};

/// Networks, one per seed from 0 on.
const NETWORKS: u64 = 24;
const NAMES: [&str; 4] = ["fast", "main", "slow", "slower"];

fn try_to_spread(model: &QModel, sizes: &[u64]) -> Result<Compiled> {
    let region = |(name, bytes): (&&str, &u64)| Region { name: (*name).into(), bytes: Some(*bytes) };
    let regions = NAMES.iter().zip(sizes).map(region).collect();
    let target = Target::find("portable").and_then(|t| t.with_regions(regions)).unwrap_or_else(|e| panic!("{e}"));
    let options = PlanOptions::for_target(&target);
    pipeline::compile(model, &target, &options, &mut |_, _, _| {})
}

fn spread(model: &QModel, sizes: &[u64]) -> Compiled {
    try_to_spread(model, sizes).unwrap_or_else(|e| panic!("{} in {sizes:?}: {e}", model.name))
}

/// Output bytes of every step on seeded inputs. Before each step every byte that holds nothing is set to `poison`.
fn outputs(compiled: &Compiled, poison: u8) -> Vec<Vec<u8>> {
    let bytes = AlignedBytes::from(compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap_or_else(|e| panic!("{e}"));
    assert!(live_ranges_are_true(&image), "the table tells an untruth, or live tensors overlap");
    let records: Vec<TensorRecord> = (0..image.tensor_count()).filter_map(|id| image.tensor(TensorId(id))).collect();
    let inputs = inputs(&image);
    let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
    let mut arena = GuardedArena::new(&image);
    let mut engine = Engine::new(image, Portable, arena.poisoned(poison)).unwrap_or_else(|e| panic!("{e}"));
    let mut found = Vec::new();
    engine.start(&inputs).unwrap_or_else(|e| panic!("{e}"));
    for position in 0.. {
        let holds = |r: &&TensorRecord| r.first_step < position.max(1) && r.is_live(position);
        let kept: Vec<&TensorRecord> = records.iter().filter(holds).collect();
        for (region, memory) in (0_u8..).zip(engine.regions_mut()) {
            let mut dead = vec![true; memory.len()];
            for record in kept.iter().filter(|record| record.region == region) {
                dead[record.offset as usize..record.end() as usize].fill(false);
            }
            memory.iter_mut().zip(dead).filter(|(_, dead)| *dead).for_each(|(byte, _)| *byte = poison);
        }
        let progress = engine.step().unwrap_or_else(|e| panic!("step {position}: {e}"));
        let output = image.step(position).and_then(|step| image.tensor(step.output())).expect("a step with an output");
        let memory = engine.regions_mut().nth(output.region.into()).expect("its region");
        found.push(memory[output.offset as usize..output.end() as usize].to_vec());
        if progress == Progress::Done {
            break;
        }
    }
    arena.check_guards().unwrap_or_else(|e| panic!("{e}"));
    found
}

fn inputs(image: &Image<'_>) -> Vec<Vec<u8>> {
    let mut generator = Generator::new(7);
    let records = (0..image.input_count()).filter_map(|input| image.tensor(image.input(input)?.tensor));
    records
        .map(|record| {
            let mut bytes = vec![0; record.bytes as usize];
            generator.fill(record.element, &mut bytes);
            bytes
        })
        .collect()
}

/// The plan keeps to its sizes, and pairs to one region.
fn assert_kept(plan: &MemoryPlan, sizes: &[u64], what: &str) {
    let found: Vec<(u64, Option<u64>)> = plan.regions.iter().map(|part| (part.bytes, part.capacity)).collect();
    assert!(found.iter().zip(sizes).all(|(part, size)| part.0 <= *size && part.1 == Some(*size)), "{what}: {found:?}");
    for tensor in &plan.tensors {
        let operand = tensor.in_place_of.map(|id| plan.tensors[id.0 as usize]);
        assert!(operand.is_none_or(|operand| operand.region == tensor.region), "{what}: {tensor:?}");
    }
}

#[test]
fn random_networks_give_the_same_bytes_in_any_regions() {
    let (mut plans, mut spread_out) = (0, 0);
    for seed in 0..NETWORKS {
        let mut graph = random_graph::graph(seed);
        model_compiler::passes::optimize(&mut graph).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        let skip = if seed.is_multiple_of(2) { SkipStages::narrow() } else { SkipStages::wide() };
        let options = QuantizeOptions { skip, ..Default::default() };
        let frames = random_graph::frames(&graph, seed, 2);
        let model = pipeline::quantize_graph(&graph, &frames, &options, &mut |_, _, _| {});
        let model = model.unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        let one = build::compiled(&model);
        let expected = outputs(&one, 0x5A);
        let arena = one.record.plan.arena_bytes();
        for sizes in [vec![arena / 4, arena], vec![arena / 2, arena * 3 / 4], vec![arena / 8, arena / 3, arena]] {
            let what = format!("seed {seed}, {sizes:?}");
            let compiled = match try_to_spread(&model, &sizes) {
                // Where no region can hold everything, a network of few large maps need not be divisible at all.
                Err(error) if error.code == ErrorCode::TooBig && sizes.iter().all(|size| *size < arena) => continue,
                compiled => compiled.unwrap_or_else(|e| panic!("{what}: {e}")),
            };
            plans += 1;
            assert_kept(&compiled.record.plan, &sizes, &what);
            assert_eq!(compiled.record.plan.order, one.record.plan.order, "{what}");
            for poison in [0x5A, 0xA5] {
                assert!(outputs(&compiled, poison) == expected, "{what}: bytes differ, dead bytes {poison:#x}");
            }
            let used = compiled.record.plan.regions.iter().filter(|part| part.bytes > 0).count();
            spread_out += usize::from(used == sizes.len());
        }
    }
    println!("{plans} of {} plans fit, {spread_out} use every region", 3 * NETWORKS);
    assert!(plans > 5 * NETWORKS / 2 && spread_out > 2 * NETWORKS as usize);
}

#[test]
fn a_driving_network_keeps_its_hottest_bytes_in_the_fastest_memory() {
    let graph = build::small(&Network::small(System::TransFuser));
    let model = build::quantized(&graph, &QuantizeOptions::default());
    let one = build::compiled(&model);
    let expected = outputs(&one, 0xA5);
    let arena = one.record.plan.arena_bytes();
    let mut last = 0.0;
    for fast in [4 << 10, 8 << 10, 16 << 10] {
        let sizes = [fast, 32 << 10, arena, arena];
        let compiled = spread(&model, &sizes);
        assert!(outputs(&compiled, 0x5A) == expected, "fast {fast}: bytes differ");
        let plan = &compiled.record.plan;
        assert_kept(plan, &sizes, "small TransFuser");
        let share = plan.traffic_share(&plan.regions[0]);
        println!("fast {fast}: {} B, {:.1} % of the traffic", plan.regions[0].bytes, 100.0 * share);
        assert!(share > last, "more of the fast memory carries more");
        last = share;
        assert_eq!(spread(&model, &sizes).image, compiled.image, "same input, same bytes");
    }
    assert!(last > 0.9, "{last}");
}

/// Half of a plan's room in either memory: neither could hold it alone.
#[test]
fn memories_that_are_too_small_alone_hold_it_together() {
    let graph = build::small(&Network::small(System::Aim));
    let model = build::quantized(&graph, &QuantizeOptions::default());
    let one = build::compiled(&model);
    let arena = one.record.plan.arena_bytes();
    // The two largest buffers of the peak apart.
    let peak = one.record.plan.regions[0].peak_step;
    let live = |p: &&model_compiler::memory_plan::Placement| (p.first_step..=p.last_step).contains(&peak);
    let largest = one.record.plan.tensors.iter().filter(live).map(|p| p.bytes).max().expect("a live tensor");
    let sizes = [arena - largest + 64, largest];
    assert!(sizes.iter().all(|size| *size < arena), "{sizes:?} of {arena}");
    let compiled = spread(&model, &sizes);
    assert_kept(&compiled.record.plan, &sizes, "aim");
    assert!(outputs(&compiled, 0x5A) == outputs(&one, 0xA5));
}

#[test]
fn the_bundled_network_is_compiled_inspected_verified_and_measured() {
    let folder = Folder::default();
    let [network, calibration] =
        [bundle::checkpoint_path(), bundle::frames_path("calibration")].map(|path| path.display().to_string());
    let frames = bundle::frames_path("evaluation").display().to_string();
    let regions = "--region fast=64K --region main=160K";
    let compiled = folder.ok(&format!("model-compiler compile {network} --calib {calibration} {regions} -o @net.img"));
    println!("{compiled}");
    for expected in ["fast  ", " of 65536 B, bound ", "main  ", " of 163840 B", "% of the traffic; peak step "] {
        assert!(compiled.contains(expected), "{expected}:\n{compiled}");
    }
    let inspected = folder.ok("model-compiler inspect @net.img");
    let row = |name: &str| {
        let line = inspected.lines().find(|line| line.trim_start().starts_with(name) && line.contains('%'));
        line.unwrap_or_else(|| panic!("{name}:\n{inspected}")).split_whitespace().map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!((row("fast")[4].as_str(), row("main")[4].as_str()), ("65536", "163840"), "capacities");
    assert!(row("fast")[5].parse::<f64>().unwrap() > 95.0, "share of the traffic:\n{inspected}");
    assert!(inspected.contains("\narena fast ") && inspected.contains("\narena main "), "{inspected}");
    let record = folder.ok("model-compiler inspect @net.record");
    assert!(record.contains("capacity") && record.contains("optimal"), "{record}");

    let verify = format!("host-sim verify @net.img --model {network} --frames {frames} --report @report");
    let outcome = folder.run(&verify);
    assert_eq!(outcome.status, 0, "{}{}", outcome.out, outcome.err);
    for expected in ["equal in every step of every frame", "  in fast", "  in main"] {
        assert!(outcome.out.contains(expected), "{expected}:\n{}", outcome.out);
    }
    let report: serde_json::Value = serde_json::from_slice(&folder.read("report/report.json")).unwrap();
    let names: Vec<_> = report["memory"]["regions"].as_array().unwrap().iter().map(|region| &region["name"]).collect();
    assert_eq!(names, ["fast", "main"]);
    assert!(report["memory"]["buffers"].as_array().unwrap().iter().all(|buffer| buffer["region"].is_string()));
    let page = String::from_utf8(folder.read("report/report.html")).unwrap();
    assert!(page.contains("It lies in 2 memory regions") && page.contains("<h3>fast</h3>"));
    assert_eq!(page.matches("id=\"hatch\"").count(), 1, "an id is unique");

    assert_eq!(folder.run(&format!("host-sim run @net.img --frames {frames}")).status, 0);
    assert_eq!(folder.run("host-sim bench @net.img --rounds 1").status, 0);
}

#[test]
fn regions_that_cannot_be_are_refused_by_name() {
    let folder = Folder::of(&Network::small(System::Aim));
    folder.ok("model-compiler quantize @net.safetensors --calib @inputs.safetensors -o @net.qmodel");
    let compile = "model-compiler compile @net.qmodel -o @new.img";
    let refused = |options: &str, parts: &[&str]| {
        let outcome = folder.run(&format!("{compile} {options}"));
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{options}");
        for part in parts {
            assert!(outcome.err.contains(part), "{options}: '{part}' not in:\n{}", outcome.err);
        }
        assert!(!folder.names().iter().any(|name| name.starts_with("new.")), "{options}: something was written");
    };
    refused("--ram 1M --region fast=64K", &["'--ram <BYTES>' cannot be used with '--region <NAME=BYTES>'"]);
    refused("--region fast", &["found \"fast\", expected NAME=BYTES"]);
    refused("--region fast=64X", &["found '64X', expected a number of bytes"]);
    refused("--region fast=1K --region fast=1M", &["--region: found the name \"fast\" twice"]);
    refused("--region tightly_coupled=1K", &["\"tightly_coupled\", expected 1 to 8 visible ASCII characters"]);
    let five = "--region a=1 --region b=1 --region c=1 --region d=1 --region e=1";
    refused(five, &["--region: found 5, expected at most 4"]);
    folder.write(
        "two.toml",
        "name = 'two'\nalignment = 4\n[[regions]]\nname = 'fast'\nbytes = '4K'\n[[regions]]\nname = 'main'\n",
    );
    let two = format!("--target {}", folder.path("two.toml").display());
    refused(
        &format!("{two} --ram 1M"),
        &["--ram: target two has 2 memories", "--region fast=BYTES --region main=BYTES"],
    );
    refused(
        "--region fast=16K --region main=64K",
        &[
            "@net.qmodel: target portable: the arena in region main needs ",
            ", 65536 are there: ",
            "\nregion fast holds ",
            " of 16384 bytes",
            "\nat the peak, step ",
            "these are live:\n",
            "  help: give the regions more bytes (--region), or use a smaller network; at step ",
            " bytes are live at once, all regions together have 81920",
        ],
    );
    // The same file is a plan of both memories where there is room.
    let text = folder.ok(&format!("{compile} {two}"));
    assert!(text.contains("fast  ") && text.contains(" of 4096 B") && text.contains("% of the traffic"), "{text}");
}
