//! Memory plans of the real networks' shapes: sizes, proofs, and a checker that catches what is wrong.

use firmware::program::{Clamp, Requant, Window};
use firmware::tensor::{ElementType, Shape};
use model_compiler::error::ErrorCode;
use model_compiler::memory_plan::{MemoryPlan, PlanOptions, PlanStatus, check, plan};
use model_compiler::qmodel::{
    Bounds, Port, QModel, QOp, QRescale, QResidual, QStep, QTensor, QTensorId, QTerm, QTokenSource, QWaypointDecoder,
};
use model_compiler::target::Target;

const KIB: u64 = 1024;
const MIB: u64 = 1024 * KIB;
const CLAMP: Clamp = Clamp { min: -128, max: 127 };
const REQUANT: Requant = Requant { multiplier: 1 << 23, shift: 23 };

/// Builds a model of shapes only: the planner never looks at constants.
struct Builder {
    model: QModel,
    /// Element type of block outputs and stems.
    skip: ElementType,
}

impl Builder {
    fn new(name: &str, skip: ElementType) -> Self {
        let model = QModel {
            name: name.into(),
            system: name.into(),
            tensors: vec![],
            steps: vec![],
            inputs: vec![],
            outputs: vec![],
            provenance: vec![],
        };
        Self { model, skip }
    }

    fn tensor(&mut self, name: &str, shape: Shape, element: ElementType) -> QTensorId {
        let (name, value) = (name.to_string(), name.to_string());
        self.model.tensors.push(QTensor {
            name,
            value,
            shape,
            element,
            scale: 1.0,
            zero_point: 0,
            saturation_ppm: None,
        });
        QTensorId(self.model.tensors.len() as u32 - 1)
    }

    fn input(&mut self, name: &str, shape: Shape, element: ElementType) -> QTensorId {
        let tensor = self.tensor(name, shape, element);
        self.model.inputs.push(Port { name: name.into(), tensor, kind: None });
        tensor
    }

    fn shape(&self, id: QTensorId) -> Shape {
        self.model.tensor(id).shape
    }

    /// Adds the output tensor and the step that writes it.
    fn step(&mut self, name: &str, shape: Shape, element: ElementType, op: impl FnOnce(QTensorId) -> QOp) -> QTensorId {
        let output = self.tensor(name, shape, element);
        self.model.steps.push(QStep { name: name.into(), node: None, op: op(output), bounds: Bounds::default() });
        output
    }

    fn conv(
        &mut self,
        name: &str,
        input: QTensorId,
        (channels, kernel, stride): (u16, u8, u8),
        element: ElementType,
        residual: Option<QTensorId>,
    ) -> QTensorId {
        let window = window(kernel, stride);
        let from = self.shape(input);
        let (height, width) = window.output_size(from.height, from.width).unwrap();
        let residual =
            residual.map_or(QResidual::None, |tensor| QResidual::Scaled { tensor, zero_point: 0, multipliers: vec![] });
        self.step(name, Shape::map(height, width, channels), element, |output| QOp::Conv2d {
            input,
            output,
            window,
            groups: 1,
            weights: vec![],
            padding_codes: vec![],
            rescale: rescale(residual),
        })
    }

    fn linear(
        &mut self,
        name: &str,
        input: QTensorId,
        channels: u16,
        element: ElementType,
        stream: Option<QTensorId>,
    ) -> QTensorId {
        let shape = Shape { channels, ..self.shape(input) };
        let residual = stream.map_or(QResidual::None, |tensor| QResidual::Stream { tensor });
        let rescale = rescale(residual);
        self.step(name, shape, element, |output| QOp::Linear { input, output, weights: vec![], wide: false, rescale })
    }

    fn max_pool(&mut self, name: &str, input: QTensorId) -> QTensorId {
        let window = window(3, 2);
        let from = self.shape(input);
        let (height, width) = window.output_size(from.height, from.width).unwrap();
        let element = self.model.tensor(input).element;
        let shape = Shape::map(height, width, from.channels);
        self.step(name, shape, element, |output| QOp::MaxPool { input, output, window })
    }

    /// The i8 form of a map that convolutions read.
    fn narrow(&mut self, name: &str, input: QTensorId) -> QTensorId {
        if self.model.tensor(input).element == ElementType::I8 {
            return input;
        }
        let shape = self.shape(input);
        self.step(&format!("{name}.narrow"), shape, ElementType::I8, |output| QOp::Requantize {
            input,
            output,
            input_zero_point: 0,
            requant: REQUANT,
            zero_point: 0,
            clamp: CLAMP,
        })
    }

    /// A stage of basic blocks; the first halves the map unless it keeps its channels.
    fn stage(&mut self, name: &str, mut x: QTensorId, channels: u16, blocks: usize) -> QTensorId {
        for block in 0..blocks {
            let name = format!("{name}.{block}");
            let q = self.narrow(&name, x);
            let grows = self.shape(x).channels != channels;
            let stride = if grows { 2 } else { 1 };
            let hidden = self.conv(&format!("{name}.conv1"), q, (channels, 3, stride), ElementType::I8, None);
            let skip =
                if grows { self.conv(&format!("{name}.skip"), q, (channels, 1, stride), self.skip, None) } else { x };
            x = self.conv(&format!("{name}.conv2"), hidden, (channels, 3, 1), self.skip, Some(skip));
        }
        x
    }

    fn layer_norm(&mut self, name: &str, input: QTensorId, first_row: u16, shape: Shape) -> QTensorId {
        self.step(name, shape, ElementType::I8, |output| QOp::LayerNorm {
            input,
            output,
            first_row,
            epsilon: 1,
            gains: vec![],
            offsets: vec![],
            shift: 0,
            zero_point: 0,
            clamp: CLAMP,
        })
    }

    fn gpt(&mut self, name: &str, maps: [QTensorId; 2], velocity: QTensorId) -> [QTensorId; 2] {
        let Shape { height, channels, .. } = self.shape(maps[0]);
        let tokens = Shape::tokens(128, channels);
        let pool = (height / 8) as u8;
        let source = |map| QTokenSource { map, zero_point: 0, pool_h: pool, pool_w: pool, multiplier: 1 };
        let mut x = self.step(&format!("{name}.tokens"), tokens, ElementType::I16, |output| QOp::Tokens {
            first: source(maps[0]),
            second: source(maps[1]),
            velocity,
            output,
            velocity_multipliers: vec![],
            position: vec![],
            shift: 0,
            zero_point: 0,
            clamp: CLAMP,
        });
        for layer in 0..8 {
            let name = format!("{name}.blocks.{layer}");
            let normed = self.layer_norm(&format!("{name}.ln1"), x, 0, tokens);
            let [query, key, value] = ["query", "key", "value"]
                .map(|part| self.linear(&format!("{name}.{part}"), normed, channels, ElementType::I8, None));
            let context = self.step(&format!("{name}.attention"), tokens, ElementType::I8, |output| QOp::Attention {
                query,
                key,
                value,
                output,
                heads: 4,
                exponent: REQUANT,
                exp_table: vec![],
                requant: REQUANT,
                zero_point: 0,
                clamp: CLAMP,
            });
            x = self.linear(&format!("{name}.proj"), context, channels, ElementType::I16, Some(x));
            let normed = self.layer_norm(&format!("{name}.ln2"), x, 0, tokens);
            let hidden = self.linear(&format!("{name}.mlp.0"), normed, 4 * channels, ElementType::I8, None);
            x = self.linear(&format!("{name}.mlp.2"), hidden, channels, ElementType::I16, Some(x));
        }
        let map = Shape::map(8, 8, channels);
        [(0, "image"), (64, "lidar")].map(|(row, part)| self.layer_norm(&format!("{name}.ln_f.{part}"), x, row, map))
    }

    /// The fused map: the enlarged output of the transformer added to the branch.
    fn fuse(&mut self, name: &str, small: QTensorId, branch: QTensorId) -> QTensorId {
        let shape = self.shape(branch);
        let (input, residual) = (term(small), term(branch));
        self.step(name, shape, self.skip, |output| {
            if shape.height == 8 {
                return QOp::Add { first: input, second: residual, output, shift: 0, zero_point: 0, clamp: CLAMP };
            }
            QOp::ResizeBilinear {
                input,
                residual: Some(residual),
                output,
                rows: vec![],
                columns: vec![],
                weight_bits: 4,
                shift: 0,
                zero_point: 0,
                clamp: CLAMP,
            }
        })
    }

    fn finish(mut self, output: QTensorId) -> QModel {
        self.model.outputs.push(Port { name: "waypoints".into(), tensor: output, kind: None });
        self.model
    }
}

fn window(kernel: u8, stride: u8) -> Window {
    let pad = kernel / 2;
    Window::square(kernel, stride, pad)
}

fn rescale(residual: QResidual) -> QRescale {
    QRescale { pre_shift: 0, bias: vec![], multipliers: vec![], shifts: vec![], zero_point: 0, clamp: CLAMP, residual }
}

fn term(tensor: QTensorId) -> QTerm {
    QTerm { tensor, zero_point: 0, multiplier: 1 }
}

/// TransFuser with 256 × 256 inputs, both branches written side by side, block outputs and stems of type `skip`.
fn transfuser(skip: ElementType) -> QModel {
    let mut b = Builder::new("transfuser", skip);
    let rgb = b.input("rgb", Shape::map(256, 256, 3), ElementType::I8);
    let bev = b.input("bev", Shape::map(256, 256, 2), ElementType::I8);
    let velocity = b.input("velocity", Shape::vector(1), ElementType::I16);
    let goal = b.input("goal", Shape::vector(2), ElementType::I32);
    let stems = [("image.stem", rgb), ("lidar.stem", bev)].map(|(name, x)| b.conv(name, x, (64, 7, 2), skip, None));
    let mut maps = [("image.pool", stems[0]), ("lidar.pool", stems[1])].map(|(name, x)| b.max_pool(name, x));
    for (stage, (channels, blocks)) in
        [(64, [3, 2]), (128, [4, 2]), (256, [6, 2]), (512, [3, 2])].into_iter().enumerate()
    {
        for (branch, name) in ["image", "lidar"].into_iter().enumerate() {
            maps[branch] = b.stage(&format!("{name}.layer{}", stage + 1), maps[branch], channels, blocks[branch]);
        }
        let small = b.gpt(&format!("transformer{}", stage + 1), maps, velocity);
        for (branch, name) in ["image", "lidar"].into_iter().enumerate() {
            maps[branch] = b.fuse(&format!("{name}.fused{}", stage + 1), small[branch], maps[branch]);
        }
    }
    let mut x = b.step("features", Shape::vector(512), ElementType::I16, |output| QOp::GlobalPool {
        first: term(maps[0]),
        second: Some(term(maps[1])),
        output,
        shift: 0,
        zero_point: 0,
        clamp: CLAMP,
    });
    for (name, channels) in [("join.0", 256), ("join.2", 128), ("join.4", 64)] {
        x = b.linear(name, x, channels, ElementType::I16, None);
    }
    let waypoints = b.step("waypoints", Shape::map(4, 1, 2), ElementType::I32, |output| {
        QOp::WaypointDecoder(QWaypointDecoder {
            hidden: x,
            goal,
            output,
            hidden_fraction_bits: 15,
            concat: false,
            input_weights: vec![],
            hidden_weights: vec![],
            input_pre_shift: 0,
            hidden_pre_shift: 0,
            input_multipliers: vec![],
            hidden_multipliers: vec![],
            shifts: vec![],
            biases: vec![],
            output_weights: vec![],
            output_bias: vec![],
            output_pre_shift: 0,
            output_requant: [REQUANT; 2],
            tanh_table: vec![],
        })
    });
    b.finish(waypoints)
}

fn portable() -> Target {
    Target::find("portable").unwrap()
}

/// Plans, has the plan checked, and prints its figures.
fn checked_plan(title: &str, model: &QModel, options: &PlanOptions) -> MemoryPlan {
    let plan = plan(model, &portable(), options).unwrap();
    if let Err(problems) = check(model, &plan) {
        panic!("{title}: {problems:#?}");
    }
    println!(
        "{title}: arena {} bytes ({:.3} MiB), bound {}, {:?}, peak at {} ({}), {} nodes",
        plan.arena_bytes(),
        plan.arena_bytes() as f64 / MIB as f64,
        plan.bound_bytes(),
        plan.status(),
        plan.regions[0].peak_step,
        model.steps[plan.order[plan.regions[0].peak_step as usize] as usize].name,
        plan.nodes
    );
    plan
}

#[test]
fn transfuser_fits_into_1_4_mib() {
    let model = transfuser(ElementType::I8);
    let plan = checked_plan("i8 maps", &model, &PlanOptions::default());
    assert_eq!(plan.status(), PlanStatus::Optimal);
    // The second stem's input and output beside the first branch's pooled map; the rest is scratch.
    assert!(plan.arena_bytes() > 128 * KIB + MIB + 256 * KIB);
    assert!(5 * plan.arena_bytes() <= 7 * MIB, "{}", plan.arena_bytes());
}

#[test]
fn transfuser_without_in_place_pooling_needs_one_and_a_half_mib() {
    let model = transfuser(ElementType::I8);
    let options = PlanOptions { in_place_pooling: false, ..PlanOptions::default() };
    let plan = checked_plan("i8 maps, pools apart", &model, &options);
    assert_eq!(plan.status(), PlanStatus::Optimal);
    // A stem, its pooled map, the other branch's pooled map; goal and velocity.
    assert_eq!(plan.arena_bytes(), MIB + 512 * KIB + 8 + 4);
}

#[test]
fn transfuser_with_wide_skips_is_planned_to_the_bound() {
    let model = transfuser(ElementType::I16);
    let plan = checked_plan("i16 skips", &model, &PlanOptions::default());
    assert_eq!(plan.status(), PlanStatus::Optimal);
    assert!(plan.arena_bytes() <= 128 * KIB + 2 * MIB + 512 * KIB + 32 * KIB);
    let apart = PlanOptions { in_place_pooling: false, ..PlanOptions::default() };
    let plan = checked_plan("i16 skips, pools apart", &model, &apart);
    assert_eq!(plan.status(), PlanStatus::Optimal);
    assert_eq!(plan.arena_bytes(), 3 * MIB + 8 + 4);
}

#[test]
fn every_alignment_is_planned_to_the_bound() {
    let model = transfuser(ElementType::I8);
    for alignment in [4, 16, 64] {
        let plan = checked_plan("aligned", &model, &PlanOptions { alignment, ..PlanOptions::default() });
        assert_eq!(plan.status(), PlanStatus::Optimal, "alignment {alignment}");
        assert!(plan.tensors.iter().all(|p| p.offset.is_multiple_of(u64::from(alignment))));
    }
    let odd = PlanOptions { alignment: 12, ..PlanOptions::default() };
    assert_eq!(plan(&model, &portable(), &odd).unwrap_err().code, ErrorCode::Usage);
}

#[test]
fn order_and_pairs_pay() {
    let model = transfuser(ElementType::I8);
    let best = checked_plan("all", &model, &PlanOptions::default());
    let own = checked_plan("own order", &model, &PlanOptions { search_order: false, ..PlanOptions::default() });
    assert!(own.order.iter().copied().eq(0..model.steps.len() as u32));
    assert!(best.arena_bytes() + 512 * KIB < own.arena_bytes());
    let apart = checked_plan("no sums in place", &model, &PlanOptions { in_place: false, ..PlanOptions::default() });
    assert!(best.tensors.iter().filter(|p| p.in_place_of.is_some()).count() > 100);
    assert!(apart.tensors.iter().filter(|p| p.in_place_of.is_some()).count() <= 2);
    assert!(best.arena_bytes() <= apart.arena_bytes());
}

#[test]
fn same_input_same_plan() {
    let model = transfuser(ElementType::I8);
    let make = || plan(&model, &portable(), &PlanOptions::default()).unwrap();
    assert_eq!(make(), make());
}

type Sabotage<'a> = &'a dyn Fn(&mut MemoryPlan);

#[test]
fn checker_catches_sabotage() {
    let model = transfuser(ElementType::I8);
    let good = checked_plan("good", &model, &PlanOptions::default());
    let id = |name: &str| model.tensors.iter().position(|t| t.name == name).unwrap();
    let taker = id("image.layer1.0.conv2");
    let stem = id("lidar.stem");
    let conv = good.scratch.iter().position(Option::is_some).unwrap();
    let cases: [(&str, Sabotage<'_>); 14] = [
        ("overlap", &|p| p.tensors[stem].offset = p.tensors[id("bev")].offset),
        ("outside the arena", &|p| p.tensors[stem].offset = p.regions[0].bytes - 4),
        ("is not a multiple", &|p| p.tensors[stem].offset += 2),
        ("bytes, expected", &|p| p.tensors[stem].bytes -= 1),
        ("live", &|p| p.tensors[stem].last_step -= 1),
        ("live", &|p| p.tensors[id("waypoints")].first_step -= 1),
        ("may not take over", &|p| p.tensors[taker].in_place_of = Some(QTensorId(stem as u32))),
        ("not at the offset", &|p| p.tensors[taker].offset += 4),
        ("overlap", &|p| p.tensors[taker].in_place_of = None),
        ("is written", &|p| p.order.swap(0, 1 + p.regions[0].peak_step as usize)),
        ("every step once", &|p| p.order[0] = p.order[1]),
        ("expected", &|p| p.regions[0].bound_bytes += 4),
        ("missing", &|p| p.scratch[conv] = None),
        ("Optimal", &|p| p.regions[0].bytes += 4),
    ];
    for (number, (reason, sabotage)) in cases.into_iter().enumerate() {
        let mut bad = good.clone();
        sabotage(&mut bad);
        let problems = check(&model, &bad).expect_err(reason);
        assert!(problems.iter().any(|p| p.contains(reason)), "case {number}: '{reason}' not in {problems:#?}");
    }
}

#[test]
fn an_operand_that_is_needed_later_is_not_overwritten() {
    // `kept` is read twice by one step, and x is read again at the end: neither may be overwritten there.
    let mut b = Builder::new("sums", ElementType::I8);
    let shape = Shape::map(8, 8, 4);
    let x = b.input("x", shape, ElementType::I8);
    let sum = |first, second| {
        move |output| QOp::Add {
            first: term(first),
            second: term(second),
            output,
            shift: 0,
            zero_point: 0,
            clamp: CLAMP,
        }
    };
    let y = b.conv("y", x, (4, 3, 1), ElementType::I8, None);
    let kept = b.step("kept", shape, ElementType::I8, sum(x, y));
    let twice = b.step("twice", shape, ElementType::I8, sum(kept, kept));
    let last = b.step("last", shape, ElementType::I8, sum(twice, x));
    let model = b.finish(last);
    let plan = checked_plan("sums", &model, &PlanOptions::default());
    let over = |t: QTensorId| plan.tensors[t.0 as usize].in_place_of;
    assert_eq!((over(kept), over(twice), over(last)), (Some(y), None, Some(twice)));
}

#[test]
fn too_big_says_by_how_much_and_why() {
    let model = transfuser(ElementType::I8);
    let plan = checked_plan("tight", &model, &PlanOptions::default());
    let exact = portable().with_limits(Some(plan.arena_bytes()), Some(5 * MIB));
    exact.fits(&model, &plan, 5 * MIB).unwrap();
    let error = exact.clone().with_limits(Some(plan.arena_bytes() - 4), None).fits(&model, &plan, 0).unwrap_err();
    assert_eq!(error.code, ErrorCode::TooBig);
    let peak = &model.steps[plan.order[plan.regions[0].peak_step as usize] as usize].name;
    for part in ["4 too many", peak.as_str(), "1048576", "goal", "--ram"] {
        assert!(error.to_string().contains(part), "'{part}' not in:\n{error}");
    }
    println!("{error}");
    let error = exact.fits(&model, &plan, 5 * MIB + 7).unwrap_err();
    assert!(error.to_string().contains("7 too many") && error.help.contains("--flash"), "{error}");
}
