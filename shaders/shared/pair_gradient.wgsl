// Adds a splat's gradient at pixel $J of a thread to the sums of the splat, and takes the splat off the colour still to
// come in the pixel's bucket $B. The splat's alpha at the pixel is `alpha`, before the cap `raw`; the pixel is `y` rows
// from the peak in its column. $M is the number at the end of all names of the splat itself, if they have one.
let w = t[$J][$B] * alpha;
let c = dot(g$J, value$M);
q[$J][$B] -= w * c;
// The cap passes no gradient.
let slope = select(t[$J][$B] * c - q[$J][$B] / (1.0 - alpha), 0.0, raw > ALPHA_CAP);
t[$J][$B] *= 1.0 - alpha;
let p = before[$J][$B] * alpha * slope;
sum_p$M += p * vec3f(1.0, y, y * y);
//#if ABSOLUTE
sum_pull$M += abs(p * pull(squares$M, dx$M, y));
//#end
sum_w$M += before[$J][$B] * w * vec4f(g$J.xyz, 1.0);
