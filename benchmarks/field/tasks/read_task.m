function task = read_task(path)
% READ_TASK  Reads a task of the benchmark of the field, in MATLAB (R2016b) or Octave (7).
%
%   task = read_task('liu_2018.json');
%   task.rates(t, x, u)              the rate of the state with the disturbance
%   task.evaluate('reference', t)    any function, of its arguments t, x, u, w
%
% t is 1 x T, x is states x T and u is inputs x T, such as the columns of ode45; a result has a
% row for each of its numbers.  README.md describes the format.
  task = jsondecode(fileread(path));
  f = task.functions;
  task.evaluate = @(name, varargin) evaluate(f.(name), varargin{:});
  task.rates = @(t, x, u) evaluate(f.rates, t, x, u, evaluate(f.disturbance, t, x));
end

function result = evaluate(f, varargin)
  inputs = vertcat(varargin{:});
  one = ones(1, size(inputs, 2));
  v = num2cell(inputs, 2)';
  first = numel(v);
  v = [v, cell(1, numel(f.program))];
  for k = 1:numel(f.program)
    v{first + k} = number(f.program{k}, v, one);
  end
  result = vertcat(zeros(0, numel(one)), v{f.results + 1});
end

function y = number(instruction, v, one)
  names = struct('add', 'plus', 'sub', 'minus', 'mul', 'times', 'div', 'rdivide', ...
                 'neg', 'uminus', 'pow', 'power', 'truncate', 'fix');
  op = instruction{1};
  switch op
    case 'const'
      y = instruction{2} * one;
    case 'lookup'
      table = instruction{3};
      place = min(max(fix(v{instruction{2} + 1}), 0), numel(table) - 1);
      y = reshape(table(place + 1), size(one));
    case 'select'
      [truth, yes, y] = v{[instruction{2:end}] + 1};
      y(truth ~= 0) = yes(truth ~= 0);
    otherwise
      if isfield(names, op)
        op = names.(op);
      end
      arguments = v([instruction{2:end}] + 1);
      y = double(feval(op, arguments{:}));
  end
  if ~isreal(y)  % outside of the domain, where NumPy has NaN
    y(imag(y) ~= 0) = NaN;
    y = real(y);
  end
end
